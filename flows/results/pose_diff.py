"""Images with the largest pose differences between two runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.run import RunRecord
from flows.registering import find_registration
from flows.results.best_results import static_cameras
from flows.results.pairing import BodiesOfBoth, bodies_of_both
from worldpose.geometry import Camera
from worldpose.store import Run, Store

JOINTS: Final = 9
"""Minimum number of a person's joints, of 17, inside the image."""


@dataclass(frozen=True)
class PoseChange:
    """Largest pose change in one camera's image.

    Attributes:
        clip: its id.
        camera: its id.
        frame: match frame.
        person: id in the first run.
        moved_px: mean distance between the person's joints in the two runs [px].
    """

    clip: str
    camera: str
    frame: int
    person: int
    moved_px: float


def largest_pose_changes(
    store: Store, a: RunRecord, b: RunRecord, most: int = 5
) -> list[PoseChange]:
    """Return the images with the largest pose changes, one per camera and clip, largest first.

    Each run's bodies are projected with its own cameras.

    Args:
        store: with both runs.
        a: the first run.
        b: the second run, of the same match.
        most: maximum number of images.
    """
    spec = find_registration(store, a.match_id).spec
    ours, theirs = Run(store, a), Run(store, b)
    before, after = static_cameras(ours, spec), static_cameras(theirs, spec)
    found = []
    for bodies in bodies_of_both(ours, theirs):
        for name in sorted(before.keys() & after.keys()):
            found += _worst(bodies, name, before, after)
    return sorted(found, key=lambda picture: -picture.moved_px)[:most]


def _worst(
    bodies: BodiesOfBoth, name: str, before: Mapping[str, Camera], after: Mapping[str, Camera]
) -> list[PoseChange]:
    """Return a camera's image with the largest change; empty if no person of both runs is in it."""
    pairs = bodies.pairs()
    if not pairs or not len(bodies.frame):
        return []
    people = list(pairs.values())
    one = before[name].project(bodies.before[:, people])
    other = after[name].project(bodies.after[:, list(pairs)])
    away = np.linalg.norm(one - other, axis=-1)
    inside = ((one >= 0) & (one < before[name].image_size)).all(axis=-1) & np.isfinite(away)
    joints = inside.sum(axis=-1)
    mean = np.where(inside, away, 0.0).sum(axis=-1) / np.maximum(joints, 1)
    mean[joints < JOINTS] = -1.0
    frame, place = np.unravel_index(int(mean.argmax()), mean.shape)
    if mean[frame, place] < 0:
        return []
    return [
        PoseChange(
            bodies.clip,
            name,
            int(bodies.frame[frame]),
            int(bodies.person_before[people[place]]),
            float(mean[frame, place]),
        )
    ]
