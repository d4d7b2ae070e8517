"""People to search again: clearly visible ones without a detection."""

import numpy as np
import pytest
from bystander import SIZE, camera, expected

from data_contracts.pitch import PitchSpec
from worldpose.detection.pipeline import Place
from worldpose.detection.settings import RedetectionSettings
from worldpose.filtering.redetection import find_detected_people, select_missing_people
from worldpose.pitch.template import PitchTemplate

SETTINGS = RedetectionSettings()


def sought(bodies, *seen, **kwargs):
    known = np.zeros(bodies.image.shape[:2], dtype=bool)
    known[:, list(seen)] = True
    found = select_missing_people(bodies, known, SIZE, SETTINGS, **kwargs)
    return found.person.tolist(), found.hidden


def test_who_was_not_detected_is_looked_for_where_the_body_is():
    bodies = expected((0.0, 0.0), (3.0, 0.0))
    found = select_missing_people(bodies, np.array([[True, False]]), SIZE, SETTINGS)
    assert (found.frame.tolist(), found.person.tolist(), found.hidden) == ([0], [1], 0)
    np.testing.assert_array_equal(found.boxes, bodies.boxes[0, 1:])


@pytest.mark.parametrize(
    ("where", "deviation"),
    [
        ((0.0, 40.0), 0.02),  # 31 px high
        ((0.0, 0.0), 0.2),  # may be any person there
        ((10.05, 0.0), 0.02),  # at the border: seven joints are in the image
        ((0.0, -30.0), 0.02),  # behind the camera
    ],
)
def test_who_would_not_be_seen_well_is_not_looked_for(where, deviation):
    assert sought(expected(where, deviation=deviation)) == ([], 0)


def test_who_is_hidden_is_not_looked_for_and_counted():
    behind = expected((0.0, 0.0), (0.0, 1.0))
    assert sought(behind, 0) == ([], 1)
    assert sought(behind, 1) == ([0], 0)


def test_nobody_is_looked_for_off_the_pitch():
    pitch = Place(camera(), PitchTemplate.from_spec(PitchSpec(length=105.0, width=68.0)))
    bodies = expected((0.0, 0.0), (3.0, 37.0))  # the second 3 m behind the touch line
    low = RedetectionSettings(min_height_px=20.0)
    nobody = np.zeros((1, 2), dtype=bool)
    assert select_missing_people(bodies, nobody, SIZE, low).person.tolist() == [0, 1]
    found = select_missing_people(bodies, nobody, SIZE, low, place=pitch, margin=2.5)
    assert found.person.tolist() == [0]


def test_seen_is_who_has_a_detection_that_fits_or_that_nobody_could_judge():
    # One frame: tracking's detection of five people, and the person that each detection fits.
    index = np.array([[0, 1, 2, -1, 9]])  # 9: found again in the iteration before
    fits = np.array([[0, -1, -1, 3]])
    dropped = np.array([[False, True, False, False]])
    # Fits; fits no person; too few keypoints; unassigned; searched again.
    assert find_detected_people(index, fits, dropped).tolist() == [[True, False, True, True, False]]


def test_who_has_the_detection_of_another_is_not_seen():
    index, fits = np.array([[0, -1]]), np.array([[1]])
    assert find_detected_people(index, fits, np.zeros((1, 1), dtype=bool)).tolist() == [
        [False, True]
    ]
