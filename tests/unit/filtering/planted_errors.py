"""A scene whose detector puts some keypoints far off, with bodies that are nearly right."""

from dataclasses import dataclass

import numpy as np

from worldpose.cameras import Camera
from worldpose.filtering import Suspects, perceived_joints, view_bodies
from worldpose.synthetic.scenarios import SCENARIOS
from worldpose.synthetic.scene import simulate_scene

SPREAD = 0.015
"""Of the bodies' joints [m]: what fitting leaves of people whom several cameras see."""


@dataclass(frozen=True, eq=False)
class Planted:
    """Everything of it.

    Attributes:
        cameras: batch (cameras,).
        views: the bodies.
        suspects: the detections, taken for the people that they are.
        displaced: (frames, cameras, detections, 17) keypoints put far off.
        person: (frames, cameras, detections) who each is; -1 = nobody.
    """

    cameras: Camera
    views: object
    suspects: Suspects
    displaced: np.ndarray
    person: np.ndarray


def plant(seed, scenario="tiny", duration=0.8, displaced=0.06):
    """Return a scene of which that share of keypoints is far off, and nothing else is wrong."""
    base = SCENARIOS[scenario]
    wrong = {"displaced": displaced, "swapped": 0.0, "stolen": 0.0, "merged": 0.0}
    noise = base.noise.model_copy(update=wrong)
    scene = simulate_scene(
        base.model_copy(update={"duration": duration, "noise": noise, "broadcast": None}), seed
    )
    seen = [scene.observations[name] for name in scene.cameras]
    who = [scene.identities[name] for name in scene.cameras]
    most = max(each.keypoints.shape[1] for each in seen)

    def together(arrays, missing):
        padded = [
            np.pad(
                each,
                [(0, 0), (0, most - each.shape[1])] + [(0, 0)] * (each.ndim - 2),
                constant_values=missing,
            )
            for each in arrays
        ]
        return np.stack(padded, axis=1)

    keypoints = together([each.keypoints.astype(float) for each in seen], np.nan)
    person = together([each.person for each in who], -1)
    index = np.full((*person.shape[:2], len(scene.truth.person_ids)), -1)
    frame, camera, place = np.nonzero(person >= 0)
    index[frame, camera, person[frame, camera, place]] = place
    rng = np.random.default_rng(seed)
    joints = scene.truth.joints + rng.normal(0.0, SPREAD, scene.truth.joints.shape)
    covariance = np.broadcast_to(SPREAD**2 * np.eye(3), (*joints.shape, 3))
    cameras = Camera.stack(list(scene.cameras.values()))
    return Planted(
        cameras,
        view_bodies(cameras, perceived_joints(joints, np.zeros((17, 3))), covariance),
        Suspects(
            keypoints,
            together([each.confidence.astype(float) for each in seen], np.nan),
            index,
            np.zeros((*index.shape, 2)),
            np.zeros((*index.shape, 3), dtype=bool),
            np.zeros(person.shape, dtype=bool),
            (1.5, 0.04),
        ),
        together([each.displaced for each in who], False),
        person,
    )
