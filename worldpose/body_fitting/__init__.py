"""Body fitting: shape, position, orientation and joint angles of every person's body (S1-S3).

Input: triangulated joints with covariance, a body model, and the ground where known. Output: body
parameters, the bodies' keypoints with covariance, and the detector's systematic offsets.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.body_fitting.body_fit import (
        BodyFit,
        ClipEvidence,
        EvidenceSource,
        fit_bodies,
        fit_in_windows,
        random_covariance,
    )
    from worldpose.body_fitting.bones import (
        BoneLengths,
        Shape,
        fit_shape,
        measure_bones,
        pool_shapes,
    )
    from worldpose.body_fitting.extra_points import ExtraFit, perceived_points
    from worldpose.body_fitting.fit_quality import (
        BodyFittingReport,
        FitMetrics,
        HeldOutComparison,
        SeenClip,
        compare_held_out,
        far_offsets,
        report_fit,
    )
    from worldpose.body_fitting.monocular import (
        MonocularEstimates,
        MonocularPoses,
        place_monocular_poses,
        read_monocular,
    )
    from worldpose.body_fitting.objective import Ground, perceived_joints
    from worldpose.body_fitting.plane_bodies import (
        PlaneBodies,
        PlaneEvidence,
        fit_bodies_on_plane,
    )
    from worldpose.body_fitting.ray_constraints import (
        RayConstraints,
        constrain_to_rays,
        find_ray_constraints,
        identify_people,
        shift_frames,
    )
    from worldpose.body_fitting.settings import BodyFittingSettings

__all__ = [
    "BodyFit",
    "BodyFittingReport",
    "BodyFittingSettings",
    "BoneLengths",
    "ClipEvidence",
    "EvidenceSource",
    "ExtraFit",
    "FitMetrics",
    "Ground",
    "HeldOutComparison",
    "MonocularEstimates",
    "MonocularPoses",
    "PlaneBodies",
    "PlaneEvidence",
    "RayConstraints",
    "SeenClip",
    "Shape",
    "compare_held_out",
    "constrain_to_rays",
    "far_offsets",
    "find_ray_constraints",
    "fit_bodies",
    "fit_bodies_on_plane",
    "fit_in_windows",
    "fit_shape",
    "identify_people",
    "measure_bones",
    "perceived_joints",
    "perceived_points",
    "place_monocular_poses",
    "pool_shapes",
    "random_covariance",
    "read_monocular",
    "report_fit",
    "shift_frames",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.body_fitting.body_fit": (
            "BodyFit",
            "ClipEvidence",
            "EvidenceSource",
            "fit_bodies",
            "fit_in_windows",
            "random_covariance",
        ),
        "worldpose.body_fitting.bones": (
            "BoneLengths",
            "Shape",
            "fit_shape",
            "measure_bones",
            "pool_shapes",
        ),
        "worldpose.body_fitting.extra_points": ("ExtraFit", "perceived_points"),
        "worldpose.body_fitting.fit_quality": (
            "BodyFittingReport",
            "FitMetrics",
            "HeldOutComparison",
            "SeenClip",
            "compare_held_out",
            "far_offsets",
            "report_fit",
        ),
        "worldpose.body_fitting.monocular": (
            "MonocularEstimates",
            "MonocularPoses",
            "place_monocular_poses",
            "read_monocular",
        ),
        "worldpose.body_fitting.objective": ("Ground", "perceived_joints"),
        "worldpose.body_fitting.plane_bodies": (
            "PlaneBodies",
            "PlaneEvidence",
            "fit_bodies_on_plane",
        ),
        "worldpose.body_fitting.ray_constraints": (
            "RayConstraints",
            "constrain_to_rays",
            "find_ray_constraints",
            "identify_people",
            "shift_frames",
        ),
        "worldpose.body_fitting.settings": ("BodyFittingSettings",),
    },
)
