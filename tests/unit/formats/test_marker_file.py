"""TRC files hold the joints as OpenSim reads them."""

import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyParameters
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import write_markers, write_motion
from worldpose.simulation.recorded_files import read_bvh


def read_trc(path):
    """Frames, times, marker names and coordinates of a TRC file, NaN for empty cells."""
    lines = path.read_text().split("\n")
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    names = lines[3].split("\t")[2::3]
    assert lines[5] == ""
    rows = [line.split("\t") for line in lines[6:-1]]
    cells = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    assert cells.shape == (int(header["NumFrames"]), 2 + 3 * int(header["NumMarkers"]))
    return header, names, cells[:, 0], cells[:, 1], cells[:, 2:].reshape(len(cells), -1, 3)


@pytest.fixture
def tracks():
    joints = np.random.default_rng(0).uniform(-50.0, 50.0, (6, 2, 17, 3))
    joints[0, 1] = np.nan  # not there yet
    joints[3, 1, 5] = np.nan  # one joint lost
    joints[4, 1] = np.nan  # lost
    frames = np.array([100, 101, 102, 103, 104, 106])
    return JointTracks(frames, np.array([4, 9]), joints)


def test_joints_come_back_in_millimetres_with_y_up(tracks, tmp_path):
    write_markers(tmp_path / "p.trc", tracks, 1, 50.0)
    header, names, frames, times, markers = read_trc(tmp_path / "p.trc")
    assert (header["Units"], header["DataRate"], header["OrigDataStartFrame"]) == ("mm", "50", "1")
    assert tuple(names) == COCO17
    assert frames.tolist() == [102, 103, 104, 105, 106, 107]
    # The format's own rule: the time of frame f is (f - OrigDataStartFrame) / DataRate.
    np.testing.assert_allclose(times, (frames - 1) / 50.0, atol=1e-9)
    expected = np.full((6, 17, 3), np.nan)
    expected[[0, 1, 2, 3, 5]] = tracks.joints[1:, 1]
    back = np.stack([markers[..., 0], -markers[..., 2], markers[..., 1]], axis=-1) / 1000.0
    # Written to a micrometre.
    np.testing.assert_allclose(back, expected, atol=5.1e-7)


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
