"""Camera models: projection of world points to pixels, and unprojection of pixels to rays.

Inputs: calibrations, world points [m] or pixels. Outputs: pixels with Jacobians, rays, distances.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
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

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.geometry.cameras": (
            "Camera",
            "Projection",
        ),
        "worldpose.geometry.projection": ("fold_radius",),
        "worldpose.geometry.rays": (
            "Rays",
            "RayStatus",
            "intersect_rays",
        ),
        "worldpose.geometry.rigid": (
            "Rigid",
            "Similarity",
            "align",
            "nearest_rotation",
        ),
    },
)
