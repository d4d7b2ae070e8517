import io
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from worldpose.body.model import BodyParameters
from worldpose.errors import InputError
from worldpose.formats.archives import read_npz
from worldpose.formats.joints_file import (
    JointTracks,
    read_joints,
    read_poses,
    write_joints,
    write_poses,
)


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
    "changes",
    [
        {"frames": np.arange(3) * 1.04},
        {"person_ids": np.array([0.5, 1.5])},
        {"views": np.full((3, 2, 17), 300)},
    ],
)
def test_numbers_that_a_file_would_cut_are_refused(changes):
    with pytest.raises(InputError, match=f"{next(iter(changes))}: expected whole numbers"):
        JointTracks(**arrays(**changes))


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


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    transl = rng.uniform(-50.0, 50.0, (3, 5, 3))
    transl[1, 2] = np.nan
    return BodyParameters(
        rng.standard_normal((3, 1, 10)),
        rng.standard_normal((3, 5, 3)),
        rng.standard_normal((3, 5, 69)),
        transl,
    )


def test_poses_come_back_in_single_precision(poses, tmp_path):
    write_poses(tmp_path / "clip.npz", poses, "open-neutral/2")
    back, body_model = read_poses(tmp_path / "clip.npz")
    assert body_model == "open-neutral/2"
    for name in ("betas", "global_orient", "body_pose", "transl"):
        np.testing.assert_array_equal(
            getattr(back, name), getattr(poses, name).astype(np.float32).astype(np.float64)
        )
    with np.load(tmp_path / "clip.npz") as file:
        assert {name: file[name].shape for name in file.files} == {
            "betas": (3, 10),
            "global_orient": (3, 5, 3),
            "body_pose": (3, 5, 69),
            "transl": (3, 5, 3),
            "body_model": (1,),
        }


def test_a_file_without_an_array_is_refused(tmp_path):
    np.savez(tmp_path / "half.npz", betas=np.zeros((1, 10)))
    with pytest.raises(InputError, match=r"half\.npz"):
        read_poses(tmp_path / "half.npz")


def written(path, **members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            if not isinstance(content, bytes):
                form = io.BytesIO()
                np.lib.format.write_array(form, content, version=(1, 0))
                content = form.getvalue()
            file.writestr(f"{name}.npy", content)
    return path


def header(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 10**12), }\n"),
            "npy array",
        ),
        (header("{'descr': '<f4', 'fortran_order': False, 'shape': (10, 100), }\n"), "4073 bytes"),
        (header("[" * 3000 + "]" * 3000), "npy array"),
        (header("__import__('os').system('id')\n"), "npy array"),
        (header("{'descr': '<z9', 'fortran_order': False, 'shape': (1,), }\n"), "z9"),
        (header("{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (1,)}\n"), "plain"),
        (b"", "npy array"),
    ],
)
def test_a_member_that_lies_is_named(tmp_path, content, told):
    path = written(tmp_path / "a.npz", score=content)
    with pytest.raises(InputError, match=told) as caught:
        read_npz(path, 10**6)
    assert caught.value.where == f"{path}: score.npy"
    assert len(str(caught.value)) < 600


def test_arrays_beyond_the_limit_are_not_unpacked(tmp_path):
    path = written(tmp_path / "a.npz", score=np.zeros(1000))
    with pytest.raises(InputError, match="at most 7000 bytes of arrays, found 8128 bytes"):
        read_npz(path, 7000)


def test_a_packed_size_that_is_more_than_the_file_does_not_excuse_a_bomb(tmp_path):
    path = written(tmp_path / "a.npz", a=np.zeros((1 << 20, 9)))
    with pytest.raises(InputError, match="packed at most 200 to 1"):
        read_npz(path, 1 << 30)
    content = bytearray(path.read_bytes())
    directory = content.rindex(b"PK\x01\x02")
    content[directory + 20 : directory + 24] = (1 << 30).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(InputError, match="packed at most 200 to 1"):
        read_npz(path, 1 << 30)


def test_no_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="expected a whole npz file"):
        read_npz(tmp_path / "a.npz", 1000)
