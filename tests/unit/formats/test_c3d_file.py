"""C3D files hold the joints as other programs' readers find them."""

import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.errors import InputError
from worldpose.formats.c3d_file import write_c3d
from worldpose.formats.joints_file import JointTracks

NOTES = {"licence": "For tests alone.\n" + "A long line. " * 40, "kind": "mixed"}
FRAMES = np.array([100, 101, 102, 103, 105])


@pytest.fixture
def tracks():
    """Two people over five frames and a frame that both lack; the second has gaps."""
    joints = np.random.default_rng(0).uniform(-60.0, 60.0, (5, 2, 17, 3))
    joints[0, 1] = np.nan
    joints[2, 1, 5] = np.nan
    covariance = np.zeros((5, 2, 17, 3, 3)) + np.diag([1e-4, 4e-4, 4e-4])  # 17.3 mm in the mean
    views = np.full((5, 2, 17), 3)
    views[3, 1, 7] = 0  # filled
    return JointTracks(FRAMES, np.array([4, 9]), joints, covariance, views)


def expected(tracks, person):
    joints = np.full((6, 17, 3), np.nan)
    joints[FRAMES - 100] = tracks.joints[:, person]
    return joints


def test_ezc3d_finds_the_joints_within_a_tenth_of_a_millimetre(tracks, tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(tmp_path / "p.c3d", tracks, 1, 50.0, NOTES)
    file = ezc3d.c3d(str(tmp_path / "p.c3d"))
    point, event = file["parameters"]["POINT"], file["parameters"]["EVENT"]
    assert point["LABELS"]["value"] == list(COCO17)
    assert point["UNITS"]["value"] == ["mm"]
    assert (point["RATE"]["value"], file["header"]["points"]["frame_rate"]) == ([50.0], 50.0)
    points = file["data"]["points"][:3].transpose(2, 1, 0) / 1000.0
    np.testing.assert_allclose(points, expected(tracks, 1), atol=1e-4)
    residuals = file["data"]["meta_points"]["residuals"][0].T
    assert residuals[0].tolist() == residuals[4].tolist() == [-1.0] * 17
    assert (residuals[2, 5], residuals[3, 7]) == (-1.0, 0.0)
    assert event["LABELS"]["value"] == ["Clip begin", "Clip end"]
    np.testing.assert_allclose(event["TIMES"]["value"], [[0.0, 0.0], [0.0, 0.1]], atol=1e-6)
    about = file["parameters"]["WORLDPOSE"]
    assert about["KIND"]["value"] == ["mixed"]
    assert " ".join(about["LICENCE"]["value"]).split() == NOTES["licence"].split()


def test_what_the_format_cannot_hold_is_refused(tracks, tmp_path):
    path = tmp_path / "p.c3d"
    with pytest.raises(InputError, match=r"WORLDPOSE:LICENCE: expected a text of at most 255"):
        write_c3d(path, tracks, 0, 50.0, {"licence": "word " * 5000})
    long = JointTracks(np.array([0, 1 << 24]), np.array([4]), np.zeros((2, 1, 17, 3)))
    with pytest.raises(InputError, match=r"expected 1 to 16777216 frames.*found 16777217"):
        write_c3d(path, long, 0, 50.0, {})
    none = JointTracks(np.zeros(0, np.int64), np.array([4]), np.zeros((0, 1, 17, 3)))
    with pytest.raises(InputError, match="found 0"):
        write_c3d(path, none, 0, 50.0, {})
    assert not path.exists()


def test_a_long_clip_counts_its_frames_beyond_16_bits(tmp_path):
    c3d = pytest.importorskip("c3d")
    count = 70_000
    joints = np.zeros((count, 1, 17, 3))
    joints[-1] = 1.5
    long = JointTracks(np.arange(count), np.array([4]), joints)
    write_c3d(tmp_path / "p.c3d", long, 0, 50.0, {})
    with (tmp_path / "p.c3d").open("rb") as file:
        reader = c3d.Reader(file)
        assert (reader.first_frame, reader.last_frame) == (1, count)
        *_, (_, points, _) = reader.read_frames()
    np.testing.assert_allclose(points[:, :3], 1500.0)
