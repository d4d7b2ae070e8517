"""A scene whose detector puts some keypoints far off, with bodies that are nearly right."""

from dataclasses import dataclass

import numpy as np

from worldpose.body_fitting.evidence import perceived_joints
from worldpose.filtering.judging import TriangulatedDetections, view_bodies
from worldpose.geometry.cameras import Camera
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene

SPREAD = 0.015
"""Standard deviation of the bodies' joints [m], for people that several cameras see."""


@dataclass(frozen=True, eq=False)
class Planted:
    """Everything of it.

    Attributes:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world, the true ones.
        views: the bodies.
        suspects: the detections, taken for the people that they are.
        displaced: (frames, cameras, detections, 17) keypoints put far off.
        person: (frames, cameras, detections) person of each; -1 = none.
    """

    cameras: Camera
    joints: np.ndarray
    views: object
    suspects: TriangulatedDetections
    displaced: np.ndarray
    person: np.ndarray


def plant(seed, scenario="tiny", duration=0.8, displaced=0.06):
    """Return a scene of which that share of keypoints is far off, and nothing else is wrong."""
    base = SCENARIOS[scenario]
    wrong = {"displaced": displaced, "swapped": 0.0, "stolen": 0.0, "merged": 0.0}
    noise = base.noise.model_copy(update=wrong)
    scene = simulate_scene(
        base.model_copy(update={"duration": duration, "noise": noise, "broadcast": ()}), seed
    )
    seen = scene.static_views()
    index = seen.index(len(scene.truth.person_ids))
    rng = np.random.default_rng(seed)
    joints = scene.truth.joints + rng.normal(0.0, SPREAD, scene.truth.joints.shape)
    covariance = np.broadcast_to(SPREAD**2 * np.eye(3), (*joints.shape, 3))
    cameras = Camera.stack(list(scene.cameras.values()))
    return Planted(
        cameras,
        scene.truth.joints,
        view_bodies(cameras, perceived_joints(joints, np.zeros((17, 3))), covariance),
        TriangulatedDetections(
            seen.detections.assign_people(index),
            np.zeros((*index.shape, 2)),
            np.zeros((*index.shape, 3), dtype=bool),
            np.zeros(seen.person.shape, dtype=bool),
            (1.5, 0.04),
        ),
        seen.displaced,
        seen.person,
    )
