"""The frame of a camera that shows a match frame, by its clock's offset and rate."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from data_contracts.match import CameraSpec
from worldpose.ingest.clock import camera_frames, remaining_offset, simplest_offset
from worldpose.ingest.footage import UnitFrames

FRAME = np.arange(8)


@pytest.mark.parametrize(
    ("offset", "rate", "shown"),
    [
        (3, 1.0, [3, 4, 5, 6, 7, 8, 9, 10]),
        (((3, 0), (4, -2)), 1.0, [0, 1, 2, 3, 2, 3, 4, 5]),  # two frames lost after frame 3
        (((0, 0), (4, 2)), 1.0, [0, 2, 3, 5, 6, 7, 8, 9]),  # fast until frame 4
        (0, 0.5, [0, 1, 1, 2, 2, 3, 3, 4]),
    ],
)
def test_a_match_frame_has_its_nearest_camera_frame(offset, rate, shown):
    assert camera_frames(FRAME, offset, rate).tolist() == shown


def test_the_rest_is_how_much_later_the_camera_frame_is():
    # Exact frames are 0, 1.5, 3, 4.5, 6 at a rate of 1.5 frames per match frame.
    assert remaining_offset(FRAME[:5], 0, 1.5) == pytest.approx([0, 1 / 3, 0, 1 / 3, 0])


def test_people_of_a_fast_camera_lie_on_match_frames(make_people, tmp_path):
    people = make_people(0, 12)
    frames = UnitFrames(0, 8, ((0, 0), (4, 2)), ((0, 2), (4, 4)))
    placed = frames.place(tmp_path, replace(people, frame=np.arange(12)))
    np.testing.assert_array_equal(placed.frame, [0, 1, 4, 5, 6, 7])
    np.testing.assert_array_equal(placed.keypoints, people.keypoints[[0, 2, 6, 7, 8, 9]])


@pytest.mark.parametrize(
    ("offset", "kind", "told"),
    [
        (0.5, "static", r"in pairs as \[\[0, 0.5\]\]"),
        (((3, 1), (3, 2)), "static", "rising match frames"),
        ((), "static", "rising match frames"),
        (((0, 1), (9, 2)), "broadcast", "broadcast_offset_frames"),
        (7.0, "broadcast", "broadcast_offset_frames"),
    ],
)
def test_an_offset_that_cannot_be_read_is_refused(offset, kind, told):
    with pytest.raises(ValidationError, match=told):
        CameraSpec(id="a", width=9, height=9, kind=kind, offset_frames=offset)


@pytest.mark.parametrize(
    ("frame", "exact", "written"),
    [
        ([0], [-0.4], 0),
        ([0, 74, 75], [0.1, 0.1, -4.9], ((74, 0.0), (75, -5.0))),
        ([0, 999], [0.0, -5.674], ((0, 0.0), (999, -5.67))),
        ([5, 30, 31, 90], [2.0, 2.0, 0.0, 3.0], ((5, 2.0), (30, 2.0), (31, 0.0), (90, 3.0))),
    ],
)
def test_offsets_are_written_as_simply_as_they_are(frame, exact, written):
    assert simplest_offset(np.array(frame), np.array(exact)) == written
