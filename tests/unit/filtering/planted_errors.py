"""A scene whose detector puts some keypoints far off, with bodies that are nearly right."""

from types import SimpleNamespace

import numpy as np

from worldpose.body_fitting.evidence import perceived_joints
from worldpose.filtering.judging import TriangulatedDetections, view_bodies
from worldpose.geometry.cameras import Camera
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene

SPREAD = 0.015
"""Standard deviation of the bodies' joints [m], for people that several cameras see."""


def plant(seed, scenario="tiny", duration=0.8, displaced=0.06):
    """Return a scene of which that share of keypoints is far off, and nothing else is wrong.

    It has cameras (cameras,), the true joints (frames, persons, 17, 3) [m, world], `views` of the
    bodies, the detections `suspects` that are taken for the people that they are, and of each
    detection (frames, cameras, detections) its `person`, -1 = none, and keypoints `displaced`.
    """
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
    suspects = TriangulatedDetections(
        *(seen.detections.assign_people(index), np.zeros((*index.shape, 2))),
        *(np.zeros((*index.shape, 3), dtype=bool), np.zeros(seen.person.shape, dtype=bool)),
        (1.5, 0.04),
    )
    return SimpleNamespace(
        cameras=cameras,
        joints=scene.truth.joints,
        views=view_bodies(cameras, perceived_joints(joints, np.zeros((17, 3))), covariance),
        suspects=suspects,
        displaced=seen.displaced,
        person=seen.person,
    )
