from dataclasses import replace

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.joints_file import JointTracks, read_joints, write_joints


@pytest.fixture
def tracks():
    rng = np.random.default_rng(0)
    joints = rng.normal(0.0, 10.0, (3, 2, 17, 3))
    joints[1, 0, 4] = np.nan
    return JointTracks(
        frames=np.array([10, 11, 13]),
        person_ids=np.array([4, 2]),
        joints=joints,
        covariance=rng.random((3, 2, 17, 3, 3)),
        views=rng.integers(0, 18, (3, 2, 17)),
        source=rng.integers(0, 4, (3, 2, 17)),
    )


def same(a, b):
    for name in ("frames", "person_ids", "joints", "covariance", "views", "source"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_what_is_written_is_read(tmp_path, tracks):
    write_joints(tmp_path / "joints.npz", tracks)
    same(read_joints(tmp_path / "joints.npz"), tracks)
    write_joints(tmp_path / "bare.npz", replace(tracks, covariance=None, views=None, source=None))
    bare = read_joints(tmp_path / "bare.npz")
    assert (bare.covariance, bare.views, bare.source) == (None, None, None)


def test_numpy_alone_reads_it_with_the_documented_types(tmp_path, tracks):
    write_joints(tmp_path / "joints.npz", tracks)
    with np.load(tmp_path / "joints.npz", allow_pickle=False) as file:
        assert {name: file[name].dtype.str for name in file} == {
            "frames": "<i8",
            "person_ids": "<i8",
            "joints": "<f8",
            "covariance": "<f8",
            "views": "|u1",
            "source": "|u1",
        }


def arrays(**changes):
    plain = {"frames": np.arange(3), "person_ids": np.arange(2), "joints": np.zeros((3, 2, 17, 3))}
    return {name: value for name, value in {**plain, **changes}.items() if value is not None}


INFINITE = np.zeros((3, 2, 17, 3))
INFINITE[2, 1, 9, 0] = np.inf
HALF_MISSING = np.zeros((3, 2, 17, 3))
HALF_MISSING[0, 1, 0, 2] = np.nan


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"joints": None},
            "expected the members frames, person_ids, joints .*found frames, person",
        ),
        ({"joint": np.zeros(3)}, "expected the members"),
        (
            {"joints": np.zeros((3, 2, 15, 3))},
            r"joints: expected shape \(3, 2, 17, 3\), found \(3, 2",
        ),
        ({"joints": np.zeros((3, 2, 17, 3), dtype=int)}, "expected float numbers, found <i8"),
        ({"frames": np.arange(3.0)}, "frames: expected int numbers"),
        ({"frames": np.array([0, 2, 1])}, "frames: expected frame numbers that rise"),
        ({"person_ids": np.array([1, 1])}, "person_ids: expected each id once"),
        ({"joints": INFINITE}, r"joints\[frame 2, person 1, left_wrist\]: expected finite metres"),
        ({"joints": HALF_MISSING}, r"joints\[frame 0, person 1, nose\]: expected all of x, y, z"),
        ({"views": np.full((3, 2, 17), -1)}, "views.*expected counts from 0"),
        ({"covariance": np.full((3, 2, 17, 3, 3), np.inf)}, "covariance.*expected finite"),
        ({"joints": np.array([{}], dtype=object)}, "joints.npy: expected numbers"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, changes, message):
    np.savez(tmp_path / "bad.npz", **arrays(**changes))
    with pytest.raises(InputError, match=message) as caught:
        read_joints(tmp_path / "bad.npz")
    assert str(tmp_path / "bad.npz") in str(caught.value)
