"""Triangulation: 3D joints of all tracked persons, with covariance (T3, T4).

Inputs: cameras, detected keypoints, and the detection of each person in each view. Outputs: joints
[m] per frame and of whole tracks, with covariance and inlier views; clock offsets of the cameras.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.triangulation.chunking import (
        Chunk,
        ClipModel,
        Reconstruction,
        learn_clip,
        reconstruct_chunks,
        reconstruct_joints,
    )
    from worldpose.triangulation.clocks import CameraClocks, estimate_clocks, shift_in_time
    from worldpose.triangulation.limb_lengths import undo_swaps
    from worldpose.triangulation.passes import (
        DetectorModel,
        ExtraJoints,
        Triangulation,
        triangulate_joints,
    )
    from worldpose.triangulation.reports import TriangulationReport
    from worldpose.triangulation.settings import TriangulationSettings
    from worldpose.triangulation.smoothing import Smoothing, smooth_joints

__all__ = [
    "CameraClocks",
    "Chunk",
    "ClipModel",
    "DetectorModel",
    "ExtraJoints",
    "Reconstruction",
    "Smoothing",
    "Triangulation",
    "TriangulationReport",
    "TriangulationSettings",
    "estimate_clocks",
    "learn_clip",
    "reconstruct_chunks",
    "reconstruct_joints",
    "shift_in_time",
    "smooth_joints",
    "triangulate_joints",
    "undo_swaps",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.triangulation.chunking": (
            "Chunk",
            "ClipModel",
            "Reconstruction",
            "learn_clip",
            "reconstruct_chunks",
            "reconstruct_joints",
        ),
        "worldpose.triangulation.clocks": (
            "CameraClocks",
            "estimate_clocks",
            "shift_in_time",
        ),
        "worldpose.triangulation.limb_lengths": ("undo_swaps",),
        "worldpose.triangulation.passes": (
            "DetectorModel",
            "ExtraJoints",
            "Triangulation",
            "triangulate_joints",
        ),
        "worldpose.triangulation.reports": ("TriangulationReport",),
        "worldpose.triangulation.settings": ("TriangulationSettings",),
        "worldpose.triangulation.smoothing": (
            "Smoothing",
            "smooth_joints",
        ),
    },
)
