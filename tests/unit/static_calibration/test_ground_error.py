"""Points to click next."""

import numpy as np
from clicking_people import PITCH, seat, visible

from worldpose.static_calibration.ground_error import propose_clicks
from worldpose.static_calibration.parameters import CameraEstimate


def test_advice_is_given_for_a_camera_with_variances_beyond_float64():
    camera, _ = seat(0)
    seen = visible(camera)
    # Variances of 1e40 in one direction: the matrix of the gain is singular in float64.
    estimate = CameraEstimate(camera, np.full((12, 12), 1e40) + np.eye(12))
    advised = propose_clicks(estimate, PITCH, (), noise=1.0)
    assert 1 <= len(advised) <= 3
    assert set(advised) <= set(seen) | set(PITCH.marking_names)
