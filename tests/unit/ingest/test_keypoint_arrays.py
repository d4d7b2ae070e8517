from dataclasses import replace

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.keypoint_files import (
    read_keypoint_arrays,
    read_observations,
    read_people,
    select_ranges,
    write_keypoint_arrays,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cam1.npz"


@pytest.fixture
def refusal(path):
    def caught():
        with pytest.raises(InputError) as error:
            read_keypoint_arrays(path)
        assert error.value.where.startswith(str(path))
        return error.value

    return caught


def members(people):
    return {"frame": people.frame, **people.arrays()}


def assert_same(a, b):
    for name, array in members(a).items():
        np.testing.assert_array_equal(array, members(b)[name])
        assert array.dtype == members(b)[name].dtype


def test_written_people_come_back(path, make_people):
    people = make_people(5, 4, 3)
    write_keypoint_arrays(path, people)
    assert_same(read_keypoint_arrays(path), people)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_numpys_own_files_are_read_and_ours_by_numpy(path, make_people, save):
    people = make_people()
    save(path, **members(people))
    assert_same(read_keypoint_arrays(path), people)
    write_keypoint_arrays(path, people)
    with np.load(path, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["keypoints"], people.keypoints)


@pytest.mark.parametrize("kept", [0, 1, 10, 0.3, 0.6, 0.99])
def test_truncated_file_is_refused(path, make_people, refusal, kept):
    write_keypoint_arrays(path, make_people())
    content = path.read_bytes()
    path.write_bytes(content[: kept if isinstance(kept, int) else int(kept * len(content))])
    assert "a whole npz file" in refusal().expected


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("frame", lambda a: a.astype(np.int32), "<i8"),
        ("frame", lambda a: a[:-1], "shape"),
        ("frame", lambda a: a[::-1], "rise"),
        ("frame", lambda a: a + 2**40, "up to"),
        ("keypoints", lambda a: a.astype(">f4"), "little-endian"),
        ("keypoints", lambda a: a.astype(object), "Python objects"),
        ("keypoints", lambda a: a[:, :, :16], "17, 2)"),
        ("boxes", lambda a: a[..., [2, 3, 0, 1]], "x0 y0 x1 y1"),
        ("boxes", lambda a: a * np.float32(np.nan), "a box for every person"),
        ("score", lambda a: a * np.float32(np.nan), "a score for every person"),
        ("score", lambda a: a + np.float32(np.inf), "finite"),
        ("score", lambda a: a - 2, "from 0"),
        ("confidence", lambda a: a + 1, "(0, 1]"),
        ("confidence", lambda a: a * np.float32(np.nan), "finite exactly where"),
        ("keypoints", lambda a: a * np.float32(np.nan), "finite exactly where"),
        ("keypoints", lambda a: a + np.float32(np.inf), "pixels"),
    ],
)
def test_wrong_array_is_refused_by_name(path, make_people, refusal, name, change, words):
    arrays = members(make_people(5))
    np.savez(path, **{**arrays, name: change(arrays[name])})
    error = refusal()
    # A confidence without keypoint, or the reverse, is found at the keypoint.
    assert any(f"{path}: {part}" in error.where for part in (name, "keypoints"))
    assert words in str(error)


def test_missing_and_further_members_are_refused(path, make_people, refusal):
    arrays = members(make_people())
    np.savez(path, **arrays, extra=np.zeros(3))
    assert "extra" in refusal().found
    del arrays["score"]
    np.savez(path, **arrays)
    assert "score" in refusal().expected


@pytest.fixture
def npz(tmp_path, make_people):
    """Frames 10, 11 and 14 with two people each."""
    path = tmp_path / "cam1.npz"
    people = replace(make_people(), frame=np.array([10, 11, 14]))
    write_keypoint_arrays(path, people)
    return path, people


def test_without_a_range_the_file_is_dense_from_its_first_to_its_last_frame(npz):
    path, people = npz
    read = read_observations(path)
    np.testing.assert_array_equal(read.frame, [10, 11, 12, 13, 14])
    np.testing.assert_array_equal(read.keypoints[[0, 1, 4]], people.keypoints)
    assert np.all(np.isnan(read.keypoints[2:4]))
    assert np.all(np.isnan(read.score[2:4]))


def test_a_range_leaves_out_and_pads(npz):
    path, people = npz
    read = select_ranges(path, read_people(path).people, [(11, 6)])
    np.testing.assert_array_equal(read.frame, np.arange(11, 17))
    np.testing.assert_array_equal(read.boxes[[0, 3]], people.boxes[1:])
    assert np.all(np.isnan(read.boxes[[1, 2, 4, 5]]))


@pytest.mark.parametrize("first_frame", [0, 15, 2**40, -(10**30)])
def test_people_outside_the_wanted_frames_are_refused(npz, first_frame):
    with pytest.raises(InputError, match="found frames 10 to 14") as caught:
        select_ranges(npz[0], read_people(npz[0]).people, [(first_frame, 5)])
    assert "offset_frames" in caught.value.todo
