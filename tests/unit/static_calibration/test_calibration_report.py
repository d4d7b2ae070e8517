import clicking_people as people
import numpy as np

from data_contracts.static_calibration import STATIC_CALIBRATION
from worldpose.geometry.cameras import camera_arrays, camera_from_arrays
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.report import (
    calibration_arrays,
    calibration_attributes,
    calibration_coordinates,
    given_attributes,
)
from worldpose.store.groups import checked_arrays, checked_attributes


def test_a_calibration_keeps_its_layout():
    camera, rng = people.seat(1)
    clicks = people.click(camera, rng, wrong=60.0)
    drawn = people.draw(camera, ["touch_line_far", "goal_line_left"], rng)
    clicked = clicks.clicked.model_copy(update={"drawn": drawn})
    result = calibrate_camera(people.PITCH, clicked, people.SIZE)
    arrays = checked_arrays(
        STATIC_CALIBRATION, calibration_arrays(result), calibration_coordinates(result)
    )
    attributes = checked_attributes(
        STATIC_CALIBRATION, arrays, calibration_attributes("cam-1", result)
    )
    assert attributes["origin"] == "points"
    assert len(attributes["point"]) == 10
    assert arrays["point_inlier"].sum() == 9
    stored = camera_from_arrays(arrays)
    np.testing.assert_array_equal(stored.distortion, result.estimate.camera.distortion)


def test_a_given_camera_keeps_the_layout_without_evidence():
    camera, _ = people.seat(1)
    arrays = checked_arrays(STATIC_CALIBRATION, camera_arrays(camera), {})
    attributes = checked_attributes(STATIC_CALIBRATION, arrays, given_attributes("cam-1"))
    assert attributes["origin"] == "given"
    assert attributes["noise_scale"] is None
