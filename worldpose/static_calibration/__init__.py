"""Static calibration: a camera from the pitch markings in its image (C1-C5).

Input: a pitch template, clicked points and drawn markings. Output: a camera and its covariance.
"""

from worldpose.static_calibration.calibration import calibrate_camera
from worldpose.static_calibration.ground_error import GroundErrorMap, ground_error_map
from worldpose.static_calibration.parameters import (
    PARAMETERS,
    CameraEstimate,
    project_with_jacobian,
    step_camera,
)
from worldpose.static_calibration.report import (
    CalibrationReport,
    MarkingResidual,
    PointResidual,
    StaticCalibration,
    calibration_arrays,
    calibration_attributes,
    calibration_coordinates,
    given_attributes,
    image_problems,
    left_out_attributes,
)
from worldpose.static_calibration.settings import CameraPrior, StaticCalibrationSettings

__all__ = [
    "PARAMETERS",
    "CalibrationReport",
    "CameraEstimate",
    "CameraPrior",
    "GroundErrorMap",
    "MarkingResidual",
    "PointResidual",
    "StaticCalibration",
    "StaticCalibrationSettings",
    "calibrate_camera",
    "calibration_arrays",
    "calibration_attributes",
    "calibration_coordinates",
    "given_attributes",
    "ground_error_map",
    "image_problems",
    "left_out_attributes",
    "project_with_jacobian",
    "step_camera",
]
