"""Which exports a run can have, and why it cannot have the others."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Final

import numpy as np

from data_contracts.match import MatchSpec
from data_contracts.release import EXPORT_FORMATS
from flows.results.best_results import bodies_unit, find_clips, joint_tracks
from flows.results.export import OF_CAMERAS, POSITION_FORMATS
from flows.results.run_cameras import broadcast_views, static_cameras
from worldpose.ingest.footage import unit_frames
from worldpose.ingest.pitch_file import NO_PITCH
from worldpose.store.store import Run

OF_BROADCAST: Final = ("challenge", "challenge-2025", "tracks", "slahmr-cameras")
"""Formats of a calibrated broadcast camera."""
OF_BODIES: Final = (
    *("worldpose", "alphapose", "bvh", "mot", "gltf", "usd"),
    *("challenge", "challenge-2025", "tracks"),
)
"""Formats of the fitted bodies of every clip with people."""
OF_EXTRAS: Final = {"usd": "pxr", "rerun": "rerun", "parquet": "pyarrow"}
"""Formats to the modules that write them, which are installed apart."""


def impossible_exports(run: Run, spec: MatchSpec) -> dict[str, str]:
    """Return the formats that a run cannot have, each with the reason in a sentence."""
    clips, views = find_clips(run.record), broadcast_views(run)
    has_cameras = bool(views or static_cameras(run, spec))
    joints = (joint_tracks(run, clip, definition="detector").joints for clip in clips)
    are_in_3d = any(np.isfinite(each).any() for each in joints)
    have_bodies = all(bodies_unit(run, clip) in run for clip in clips)
    are_filmed = all(broadcast_views(run, clip) for clip in clips)
    have_rate = all(unit_frames(spec, view).rate == 1.0 for view in views)
    until = ": it waits for review" if run.record.state == "waiting" else ""

    def lack(form: str) -> Iterator[str]:
        if form in OF_BROADCAST and not views:
            yield "The run has no calibrated broadcast camera."
        if form in OF_BROADCAST and not (are_filmed and have_rate):
            yield "A clip has no broadcast camera of the frame rate of the match."
        if not clips and not (form in OF_CAMERAS and has_cameras):
            yield f"The run has no people yet{until}."
        if clips and not are_in_3d and form not in (*POSITION_FORMATS, *OF_CAMERAS):
            yield "The run has no person with joints in 3D."
        if form in OF_BODIES and not have_bodies:
            yield f"The run has no fitted bodies yet{until}."
        if form == "minimap" and spec.pitch == NO_PITCH:
            yield "The match has no pitch."
        if form in OF_EXTRAS and find_spec(OF_EXTRAS[form]) is None:
            yield "The server cannot write it: the operator can install what it needs."

    return {form: why for form in EXPORT_FORMATS if (why := next(lack(form), ""))}
