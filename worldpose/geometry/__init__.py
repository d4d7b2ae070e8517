"""Camera models: projection of world points to pixels, and unprojection of pixels to rays.

Inputs: calibrations, world points [m] or pixels. Outputs: pixels with Jacobians, rays, distances.
"""

from worldpose.geometry.cameras import Camera, Projection
from worldpose.geometry.projection import fold_radius
from worldpose.geometry.rays import (
    Rays,
    RayStatus,
    intersect_rays,
)
from worldpose.geometry.rigid import Rigid, Similarity, align, nearest_rotation

__all__ = [
    "Camera",
    "Projection",
    "RayStatus",
    "Rays",
    "Rigid",
    "Similarity",
    "align",
    "fold_radius",
    "intersect_rays",
    "nearest_rotation",
]
