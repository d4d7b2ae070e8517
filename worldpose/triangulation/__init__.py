"""Triangulation: where every joint of every tracked person is, and how sure that is (T3).

Inputs: cameras, detected keypoints, and which detection is which person. Outputs: joints [m] with
covariance, agreeing views and reprojection error.
"""

from worldpose.triangulation.robust import (
    Triangulation,
    TriangulationReport,
    triangulate_joints,
)
from worldpose.triangulation.settings import TriangulationSettings

__all__ = [
    "Triangulation",
    "TriangulationReport",
    "TriangulationSettings",
    "triangulate_joints",
]
