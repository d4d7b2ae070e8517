"""TRC files hold the joints as OpenSim reads them."""

import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.motion_capture import write_markers


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
