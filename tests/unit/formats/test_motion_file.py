"""BVH files reproduce the body's joints through another program's forward kinematics."""

import numpy as np
import pytest

from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.formats.motion_capture import write_motion
from worldpose.simulation.recorded_files import read_bvh

FRAMES = 40


@pytest.fixture(scope="module")
def model():
    return load_open_body()


def motion(seed=0):
    rng = np.random.default_rng(seed)
    return BodyParameters(
        rng.standard_normal((1, 10)),
        rng.uniform(-3.0, 3.0, (FRAMES, 3)),
        rng.uniform(-1.5, 1.5, (FRAMES, 69)),
        rng.uniform(-50.0, 50.0, (FRAMES, 3)),
    )


def joints_of(path):
    """The capture's 24 joints in SMPL's order, world metres."""
    capture = read_bvh(path)
    places = [capture.names.index(name) for name in SKELETONS["smpl24"]]
    x, y, z = np.moveaxis(capture.positions[:, places], -1, 0)
    return np.stack([x, -z, y], axis=-1) / 100.0, capture


def test_the_24_joints_come_back_within_a_tenth_of_a_millimetre(model, tmp_path):
    poses = motion()
    write_motion(tmp_path / "p.bvh", model, poses, 50.0)
    joints, capture = joints_of(tmp_path / "p.bvh")
    assert capture.fps == pytest.approx(50.0)
    # Angles and places are written to 1e-6 degrees and centimetres: below a micrometre.
    np.testing.assert_allclose(joints, model.joints(poses), atol=1e-6)


def test_a_turning_persons_angles_do_not_jump(model, tmp_path):
    turning = np.linspace(0.0, 4.0 * np.pi, FRAMES)
    poses = BodyParameters(
        np.zeros((1, 10)),
        np.outer(turning, [0.0, 1.0, 0.0]),
        np.zeros((FRAMES, 69)),
        np.zeros((FRAMES, 3)),
    )
    write_motion(tmp_path / "p.bvh", model, poses, 25.0)
    rows = (tmp_path / "p.bvh").read_text().split("\n")[-FRAMES - 1 : -1]
    channels = np.array([row.split() for row in rows], dtype=float)
    # Two turns in 39 steps are 18.5 degrees each.
    assert np.abs(np.diff(channels[:, 3:], axis=0)).max() < 19.0
