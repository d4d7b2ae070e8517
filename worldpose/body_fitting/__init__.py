"""Body fitting: shape, position, orientation and joint angles of every person's body (S1-S3).

Input: triangulated joints with covariance, a body model, and the ground where known. Output: body
parameters, the bodies' keypoints with covariance, and the detector's systematic offsets.
"""

from worldpose.body_fitting.bones import (
    BoneLengths,
    Shape,
    fit_shape,
    measure_bones,
    pool_shapes,
)
from worldpose.body_fitting.figures import BodyFittingReport, Pictures, report_fit
from worldpose.body_fitting.fitting import BodyFit, fit_bodies
from worldpose.body_fitting.monocular import MonocularEstimates, read_monocular
from worldpose.body_fitting.monocular_poses import MonocularPoses, place_monocular_poses
from worldpose.body_fitting.moving_view import between_frames, recognise_people, sight_people
from worldpose.body_fitting.ray_constraints import Sightings, find_sightings
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shared_bias import far_offsets

__all__ = [
    "BodyFit",
    "BodyFittingReport",
    "BodyFittingSettings",
    "BoneLengths",
    "MonocularEstimates",
    "MonocularPoses",
    "Pictures",
    "Shape",
    "Sightings",
    "between_frames",
    "far_offsets",
    "find_sightings",
    "fit_bodies",
    "fit_shape",
    "measure_bones",
    "place_monocular_poses",
    "pool_shapes",
    "read_monocular",
    "recognise_people",
    "report_fit",
    "sight_people",
]
