"""The pictures in which two runs differ most: where to look first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.run import RunRecord
from flows.pairing import BodiesOfBoth, bodies_of_both
from flows.registering import find_registration
from flows.release import static_cameras
from worldpose.cameras import Camera
from worldpose.store import Run, Store

JOINTS: Final = 9
"""Joints of a person in the picture, of 17, from which on the person is taken to be in it."""


@dataclass(frozen=True)
class PoseChange:
    """A picture of one camera, and who moved most in it.

    Attributes:
        clip: its id.
        camera: its id.
        frame: match frame.
        person: id in the first run.
        moved_px: mean distance of the person's joints in the one run from the other's [px].
    """

    clip: str
    camera: str
    frame: int
    person: int
    moved_px: float


def largest_pose_changes(
    store: Store, a: RunRecord, b: RunRecord, most: int = 5
) -> list[PoseChange]:
    """The pictures in which bodies moved most, one a camera and clip, the worst first.

    Each run's bodies are projected by its own cameras.

    Args:
        store: with both runs.
        a: the one run.
        b: the other, of the same match.
        most: how many pictures.
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
    """The worst picture of a camera; none where nobody of both runs is in it."""
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
