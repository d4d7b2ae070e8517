"""Body fitting: shape, place, orientation and angles of every person's body (S1-S3).

Input: triangulated joints with covariance, a body model, and the ground where it is known. Output:
body parameters, the bodies' keypoints with covariance, and what the detector always gets wrong.
"""

from worldpose.body_fitting.bones import BoneLengths, Shape, fit_shape, measure_bones
from worldpose.body_fitting.figures import BodyFittingReport, report_fit
from worldpose.body_fitting.fitting import BodyFit, fit_bodies
from worldpose.body_fitting.settings import BodyFittingSettings

__all__ = [
    "BodyFit",
    "BodyFittingReport",
    "BodyFittingSettings",
    "BoneLengths",
    "Shape",
    "fit_bodies",
    "fit_shape",
    "measure_bones",
    "report_fit",
]
