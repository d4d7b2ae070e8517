import numpy as np
import pytest
from rigs import rig

from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.bundle_adjustment.residuals import AdjustmentProblem
from worldpose.static_calibration.parameters import PARAMETERS, step_camera
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings


@pytest.fixture
def scene():
    """A function that makes a problem with known truth: markings that are fixed, and joints."""

    def make(cameras=4, markings=24, joints=30, noise=0.0, seed=1, seen=0.8):
        rng = np.random.default_rng(seed)
        true = rig(cameras, rng)
        points = np.concatenate(
            [
                rng.uniform([-18.0, -18.0, -0.5], [18.0, 18.0, 0.5], (markings, 3)),
                rng.uniform([-10.0, -10.0, 0.0], [10.0, 10.0, 2.0], (joints, 3)),
            ]
        )
        visible = rng.random((len(points), cameras)) < seen
        visible[:, :2] = True
        point_of, camera_of = np.nonzero(visible)
        image = true.project(points)[camera_of, point_of]
        free = np.ones((cameras, len(PARAMETERS)), dtype=bool)
        free[:, PARAMETERS.index("k3")] = False
        problem = AdjustmentProblem(
            cameras=true,
            free=free,
            camera_information=np.zeros((cameras, len(PARAMETERS), len(PARAMETERS))),
            points=points,
            point_information=np.where(np.arange(len(points)) < markings, np.inf, 0.0),
            point_of=point_of,
            camera_of=camera_of,
            image=image + noise * rng.standard_normal(image.shape),
            weight=np.full(len(image), 1.0 / max(noise, 1.0) ** 2),
            scale=np.full(len(image), np.inf),
        )
        return problem, true, points

    return make


KNOWN = np.array([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1, 3e-3, 2.0, 2.0, 0.01, 0.003, 0.0])
"""Standard deviations of the calibrated cameras' steps."""
STATED = TriangulationSettings(
    pixel_noise_px=1.0, joint_noise_m=0.0, learn_noise=False, offsets="none"
)


def people(frames, persons, rng):
    """Joints (frames, persons, 17, 3) of people who walk straight on."""
    start = rng.uniform([-12.0, -12.0, 0.0], [12.0, 12.0, 0.0], (persons, 3))
    way = rng.uniform([-3.0, -3.0, 0.0], [3.0, 3.0, 0.0], (persons, 3))
    body = rng.uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 1.8], (persons, 17, 3))
    times = np.arange(frames)[:, None, None] / 25.0
    return (start + times * way)[:, :, None] + body


@pytest.fixture
def clip():
    """A function that makes a clip of people before cameras that are not quite right.

    Returns the clip, the true cameras and the true joints.
    """

    def make(cameras=5, persons=6, frames=24, noise=1.0, seed=1, lasting=0.0, clicked=12):
        rng = np.random.default_rng(seed)
        true = rig(cameras, rng)
        step = KNOWN * rng.standard_normal((cameras, len(PARAMETERS)))
        base = step_camera(true, step)
        joints = people(frames, persons, rng)
        keypoints = true.project(joints.reshape(-1, 3)).reshape(cameras, frames, persons, 17, 2)
        keypoints = keypoints + noise * rng.standard_normal(keypoints.shape)
        keypoints += lasting * rng.standard_normal((cameras, 1, persons, 17, 2))
        keypoints = np.ascontiguousarray(keypoints.swapaxes(0, 1))
        index = np.broadcast_to(np.arange(persons), (frames, cameras, persons)).astype(np.int16)
        confidence = np.ones(keypoints.shape[:-1])
        frame = 100 + np.arange(frames)
        seen = KeypointDetections.from_keypoints(keypoints, confidence, index, frame)
        placed = triangulate_joints(base, seen, STATED)
        clicks = []
        for c in range(cameras):
            points = rng.uniform([-18.0, -18.0, 0.0], [18.0, 18.0, 0.3], (clicked, 3))
            pixels = true[c].project(points) + rng.standard_normal((clicked, 2))
            names = tuple(f"point_{k}" for k in range(clicked))
            used = np.ones(clicked, dtype=bool)
            clicks.append(Clicks(names, points, pixels, used, np.zeros(clicked), noise_px=1.0))
        made = Clip(
            cameras=base,
            covariance=np.tile(np.diag(KNOWN**2), (cameras, 1, 1)),
            clicks=tuple(clicks),
            fps=25.0,
            detections=seen,
            joints=placed.joints,
            views=placed.views.astype(np.int64),
            triangulation=STATED,
        )
        return made, true, joints

    return make
