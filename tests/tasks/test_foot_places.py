"""Foot positions of detections of people who are not triangulated."""

import numpy as np

from tasks.tracking import BLOCK, _Feet
from worldpose.tracking.plane.feet import FrameBlocks, GroundPositions

# Two frames of one camera with five detections; 1 and 4, then 0 alone, are not triangulated.
DETECTION = np.array([[[1, 4]], [[0, -1]]], dtype=np.int16)
FEET = _Feet(
    GroundPositions(*(np.full((2, 1, 2, *shape), np.nan) for shape in ((2,), (2, 2), (2, 2), ()))),
    FrameBlocks([DETECTION], BLOCK),
)


def test_places_are_those_of_their_detections():
    people = np.array([[[4, -1, 1]], [[-1, 0, -1]]])
    place = FEET.places_of(people)
    assert place.tolist() == [[[1, -1, 0]], [[-1, 0, -1]]]
    assert FEET.detections_of(place).tolist() == people.tolist()


def test_a_detection_without_a_place_has_none():
    assert FEET.places_of(np.array([[[2]], [[4]]])).tolist() == [[[-1]], [[-1]]]
    assert FEET.detections_of(np.array([[[-1]], [[1]]])).tolist() == [[[-1]], [[-1]]]
