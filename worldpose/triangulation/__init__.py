"""Triangulation: where every joint of every tracked person is, and how sure that is (T3, T4).

Inputs: cameras, detected keypoints, and which detection is which person. Outputs: joints [m] of
every frame and of whole tracks, with covariance and agreeing views; by how much clocks are late.
"""

from worldpose.triangulation.clocks import CameraClocks, estimate_clocks, moved_in_time
from worldpose.triangulation.exchanges import put_right
from worldpose.triangulation.reconstruction import Reconstruction, reconstruct_joints
from worldpose.triangulation.reports import TriangulationReport
from worldpose.triangulation.robust import Triangulation, triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import Smoothing, smooth_joints
from worldpose.triangulation.windows import (
    ClipDetections,
    ClipModel,
    Part,
    learn_clip,
    reconstruct_parts,
)

__all__ = [
    "CameraClocks",
    "ClipDetections",
    "ClipModel",
    "Part",
    "Reconstruction",
    "Smoothing",
    "Triangulation",
    "TriangulationReport",
    "TriangulationSettings",
    "estimate_clocks",
    "learn_clip",
    "moved_in_time",
    "put_right",
    "reconstruct_joints",
    "reconstruct_parts",
    "smooth_joints",
    "triangulate_joints",
]
