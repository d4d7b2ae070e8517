from dataclasses import replace

import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.formats.keypoint_files import (
    read_observations,
    read_people,
    select_ranges,
    write_keypoint_arrays,
)


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
