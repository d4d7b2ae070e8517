"""Calibrated cameras as records and as stored arrays."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from data_contracts.arrays import array_layouts
from data_contracts.conventions import DISTORTION
from data_contracts.records import ImageLength, Name, Record

Entry = Annotated[float, Field(ge=-1.01, le=1.01)]
"""Entry of a rotation matrix, which may be rounded."""
Vector3 = tuple[Entry, Entry, Entry]

_Bounded = Annotated[float, Field(ge=-1e7, le=1e7)]
_Focal = Annotated[float, Field(gt=0, le=1e7)]
_Distortion = tuple[_Bounded, _Bounded, _Bounded, _Bounded, _Bounded]


class CameraCalibration(Record):
    """One calibrated static camera."""

    id: Name
    image_size: tuple[ImageLength, ImageLength]
    """Width and height [px]."""
    focal_px: tuple[_Focal, _Focal]
    """fx, fy [px]."""
    principal_point_px: tuple[_Bounded, _Bounded]
    """cx, cy [px]; (0, 0) is the centre of the top-left pixel."""
    distortion: _Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3: OpenCV's order [1]."""
    rotation: tuple[Vector3, Vector3, Vector3]
    """Rows of R in x_cam = R x_world + t."""
    translation: tuple[_Bounded, _Bounded, _Bounded]
    """t in x_cam = R x_world + t [m]."""


class LensCalibration(Record):
    """The lens of a static camera whose pose is not known, with its uncertainty."""

    id: Name
    image_size: tuple[ImageLength, ImageLength]
    """Width and height [px]."""
    focal_px: _Focal
    """Focal length for square pixels [px]."""
    principal_point_px: tuple[_Bounded, _Bounded]
    """cx, cy [px]; (0, 0) is the centre of the top-left pixel."""
    distortion: _Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3: OpenCV's order [1]. p1 and p2 are kept as they are."""
    focal_std_px: Annotated[float, Field(gt=0, le=1e6)]
    """Standard deviation of the focal length [px]."""
    principal_point_std_px: Annotated[float, Field(gt=0, le=1e6)]
    """Standard deviation of the principal point, each axis [px]."""
    distortion_std: Annotated[float, Field(gt=0, le=1)]
    """Standard deviation of the displacement of the image corner by each of k1, k2 and k3, relative
    to the corner's distance from the centre [1]."""


CAMERA_LABELS: dict[str, tuple[str, ...]] = {
    "axis": ("x", "y"),
    "coefficient": DISTORTION,
    "coordinate": ("x", "y", "z"),
    "cam_coordinate": ("x_cam", "y_cam", "z_cam"),
}

CAMERA_ARRAYS = array_layouts(
    """
    focal (axis) float64 [px]:
        focal lengths fx, fy
    principal_point (axis) float64 [px]:
        principal point cx, cy; (0, 0) is the centre of the top-left pixel
    distortion (coefficient) float64 [1]:
        k1, k2, p1, p2, k3 in OpenCV's order
    rotation (cam_coordinate, coordinate) float64 [1]:
        R in x_cam = R x_world + t
    translation (cam_coordinate) float64 [m]:
        t in x_cam = R x_world + t
    image_size (axis) int64 [px]:
        width, height
    """
)
"""Arrays of one static camera."""
