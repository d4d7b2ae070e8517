import numpy as np
import pytest

from worldpose.bundle_adjustment import Problem
from worldpose.cameras import Camera, Rigid
from worldpose.static_calibration import PARAMETERS
from worldpose.synthetic.stadium import looking


def rig(count, rng):
    """Cameras around the origin, 50 m away."""
    angles = 2.0 * np.pi * np.arange(count) / count + 0.3
    centers = np.stack([50.0 * np.cos(angles), 50.0 * np.sin(angles), np.full(count, 15.0)], axis=1)
    poses = [looking(center, np.array([0.0, 0.0, 1.0]), 0.01) for center in centers]
    return Camera(
        focal=np.repeat(rng.uniform(1800.0, 2400.0, (count, 1)), 2, axis=1),
        principal_point=np.array([959.5, 539.5]) + rng.normal(0.0, 5.0, (count, 2)),
        distortion=np.array([[-0.08, 0.02, 0.0, 0.0, 0.0]] * count),
        cam_from_world=Rigid(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.translation for pose in poses]),
        ),
        image_size=np.tile([1920, 1080], (count, 1)),
    )


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
        problem = Problem(
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
