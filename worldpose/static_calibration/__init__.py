"""Static calibration: the pitch's markings in a picture to a camera (C1-C5).

Input: a pitch template and what a person clicked. Output: a camera with its uncertainty.
"""

from worldpose.static_calibration.parameters import (
    PARAMETERS,
    CameraEstimate,
    project_with_jacobian,
    stepped,
)

__all__ = ["PARAMETERS", "CameraEstimate", "project_with_jacobian", "stepped"]
