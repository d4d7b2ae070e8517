import clicking_people as people
import numpy as np
import xarray as xr

from data_contracts.static_calibration import STATIC_CALIBRATION
from tasks.bundle_adjustment import _clicks
from worldpose.geometry.cameras import camera_arrays, camera_from_arrays
from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.report import (
    calibration_arrays,
    calibration_attributes,
    calibration_coordinates,
    given_attributes,
    left_out_attributes,
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


def test_a_camera_that_is_left_out_keeps_the_layout_with_its_reason_alone():
    assert not checked_arrays(STATIC_CALIBRATION, {}, {})
    given = left_out_attributes("cam-1", "all clicks are on one line")
    attributes = checked_attributes(STATIC_CALIBRATION, {}, given)
    assert (attributes["origin"], attributes["reasons"]) == ("none", ["all clicks are on one line"])


def test_clicks_come_back_from_a_stored_camera_where_they_were_made():
    camera, rng = people.seat(1)
    clicked = people.click(camera, rng, wrong=60.0).clicked
    result = calibrate_camera(people.PITCH, clicked, people.SIZE)
    arrays = calibration_arrays(result)
    stored = xr.Dataset(
        {
            "point_pixel": (("point", "axis"), arrays["point_pixel"]),
            "point_inlier": ("point", arrays["point_inlier"]),
        },
        coords={"point": calibration_attributes("cam-1", result)["point"]},
    )
    clicks = _clicks(stored, people.PITCH)
    made = {point.name: point.xy for point in clicked.points}
    assert set(clicks.names) == set(made)
    np.testing.assert_array_equal(clicks.points_image, [made[name] for name in clicks.names])
    assert clicks.inlier.sum() == 9
