"""Images of the broadcast camera as input of body fitting: clock offsets."""

import numpy as np
import pytest
import xarray as xr
from camera_builders import look_at_camera

from tasks import refitting
from worldpose.body_fitting.monocular import MonocularEstimates
from worldpose.body_fitting.pose_space import GATHER
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.ingest.clock import ImageClock


def beside(frames):
    """A camera 70 m beside the pitch (frames,), which looks at the origin."""
    return Camera.stack([look_at_camera((0.0, -70.0, 15.0), (0.0, 0.0, 1.0), 4000.0)] * frames)


def runner(frame):
    """Joints (frames, 1, 17, 3) of a person who moves 0.7 m per frame, diagonally away."""
    body = np.stack([np.tile([-0.2, 0.2], 9)[:17], np.zeros(17), np.linspace(0.1, 1.8, 17)], -1)
    return (body + (frame - 5.5)[:, None, None] * [0.5, 0.5, 0.0])[:, None]


@pytest.mark.parametrize("late", [1.0, -2.0])
def test_bodies_of_pictures_that_are_late_are_those_of_the_frames(late):
    frame, camera = np.arange(12), beside(12)

    def turned(time):
        return Rigid.from_rotvec(time[:, None] * [0.0, 0.0, 0.1], np.zeros(3)).rotation

    rotations = np.repeat(turned(frame + late)[:, None], 24, axis=1)
    rotations[:, 0] = camera.cam_from_world.rotation @ rotations[:, 0]
    image = camera.project(runner(frame + late)[:, 0])
    middle = 0.5 * (image.min(axis=1) + image.max(axis=1))
    estimates = MonocularEstimates(104 + frame, rotations, middle, False)
    nobody, joints = xr.DataArray(np.full((12, 1, 17, 2), np.nan)), xr.DataArray(runner(frame))
    clock = ImageClock(104 + frame, np.zeros(12), 1.0)
    views = refitting._BroadcastView(clock, camera, late, nobody, joints, estimates)
    _, found = views(slice(0, 12))
    there = np.isfinite(found.orient).all(axis=(-2, -1))[:, 0]
    assert there.sum() >= 10
    np.testing.assert_allclose(found.orient[there, 0], turned(frame[there]), atol=1e-9)
    turns = frame[there, None] * np.tile([0.0, 0.0, 0.1], 23)
    np.testing.assert_allclose(found.angles[there, 0], turns @ GATHER.T, atol=1e-9)
