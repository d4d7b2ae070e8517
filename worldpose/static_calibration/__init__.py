"""Static calibration: a camera from the pitch markings in its image (C1-C5).

Input: a pitch template, clicked points and drawn markings, or an image alone. Output: a camera and
its covariance.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.static_calibration.calibration import calibrate_camera
    from worldpose.static_calibration.ground_error import GroundErrorMap, ground_error_map
    from worldpose.static_calibration.parameters import (
        PARAMETERS,
        CameraEstimate,
        project_with_jacobian,
        step_camera,
    )
    from worldpose.static_calibration.proposal import (
        MarkingSupport,
        Proposal,
        calibrate_proposal,
        calibrate_without_clicks,
        propose_camera,
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
    from worldpose.static_calibration.settings import (
        CameraPrior,
        ProposalSettings,
        StaticCalibrationSettings,
    )
    from worldpose.static_calibration.sides import SeenPeople, SideDecision, decide_sides

__all__ = [
    "PARAMETERS",
    "CalibrationReport",
    "CameraEstimate",
    "CameraPrior",
    "GroundErrorMap",
    "MarkingResidual",
    "MarkingSupport",
    "PointResidual",
    "Proposal",
    "ProposalSettings",
    "SeenPeople",
    "SideDecision",
    "StaticCalibration",
    "StaticCalibrationSettings",
    "calibrate_camera",
    "calibrate_proposal",
    "calibrate_without_clicks",
    "calibration_arrays",
    "calibration_attributes",
    "calibration_coordinates",
    "decide_sides",
    "given_attributes",
    "ground_error_map",
    "image_problems",
    "left_out_attributes",
    "project_with_jacobian",
    "propose_camera",
    "step_camera",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.static_calibration.calibration": ("calibrate_camera",),
        "worldpose.static_calibration.ground_error": (
            "GroundErrorMap",
            "ground_error_map",
        ),
        "worldpose.static_calibration.parameters": (
            "PARAMETERS",
            "CameraEstimate",
            "project_with_jacobian",
            "step_camera",
        ),
        "worldpose.static_calibration.proposal": (
            "MarkingSupport",
            "Proposal",
            "calibrate_proposal",
            "calibrate_without_clicks",
            "propose_camera",
        ),
        "worldpose.static_calibration.report": (
            "CalibrationReport",
            "MarkingResidual",
            "PointResidual",
            "StaticCalibration",
            "calibration_arrays",
            "calibration_attributes",
            "calibration_coordinates",
            "given_attributes",
            "image_problems",
            "left_out_attributes",
        ),
        "worldpose.static_calibration.settings": (
            "CameraPrior",
            "ProposalSettings",
            "StaticCalibrationSettings",
        ),
        "worldpose.static_calibration.sides": (
            "SeenPeople",
            "SideDecision",
            "decide_sides",
        ),
    },
)
