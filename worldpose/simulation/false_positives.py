"""False positives of a person detector."""

from __future__ import annotations

from typing import Final

import numpy as np

from worldpose.pitch import PitchTemplate
from worldpose.simulation.bodies import draw_body
from worldpose.simulation.gait import walk
from worldpose.simulation.occlusion import Bodies
from worldpose.simulation.paths import wander
from worldpose.simulation.processes import bursts
from worldpose.simulation.settings import CrowdSettings, Scenario

PHANTOMS: Final = 2
"""Maximum number of false positives at a time in one camera."""
POSTURES: Final = 12.0
"""Length of the walk that supplies postures [s]."""


def draw_false_positives(
    scenario: Scenario, pitch: PitchTemplate, frames: int, rng: np.random.Generator
) -> Bodies:
    """Return still human figures that appear and vanish at random places on and around the area.

    Args:
        scenario: area and the rates of false positives.
        pitch: the ground under them.
        frames: number of frames.
        rng: this camera's own: false positives of cameras are independent.
    """
    noise, crowd = scenario.noise, scenario.crowd
    share = noise.false_people / PHANTOMS
    shape = (frames, PHANTOMS)
    on = bursts(share, noise.false_people_time, shape, scenario.fps, rng)
    body = draw_body(crowd.height, rng)
    # Any moment of a walk serves as a posture; every appearance draws another.
    path = wander(CrowdSettings(height=crowd.height), POSTURES, (), rng)
    appeared = on & ~np.concatenate([np.zeros_like(on[:1]), on[:-1]])
    times = rng.uniform(0.0, POSTURES, appeared.shape)
    joints = walk(body, path, times.ravel(), lambda x, y: 0.0 * x, rng)
    joints = joints.reshape(*appeared.shape, 17, 3)
    joints[..., :2] -= joints[..., 11:13, :2].mean(axis=2, keepdims=True)
    place = np.array(crowd.area_center) + np.array(crowd.area_size) * rng.uniform(
        -1.0, 1.0, (*appeared.shape, 2)
    )
    joints[..., :2] += place[:, :, None]
    joints[..., 2] += pitch.height(place[..., 0], place[..., 1])[..., None]
    # A figure keeps the posture of its appearance.
    since = np.maximum.accumulate(np.where(appeared, np.arange(frames)[:, None], 0), axis=0)
    joints = np.take_along_axis(joints, since[..., None, None], axis=0)
    joints[~on] = np.nan
    return Bodies(joints, np.full(PHANTOMS, body.height))
