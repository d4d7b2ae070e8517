"""People to search again: clearly visible ones without a detection."""

import numpy as np
import pytest
from bystander import SIZE, expected

from worldpose.detection.settings import RedetectionSettings
from worldpose.filtering.redetection import select_missing_people

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
