"""Calibrated cameras as records and as stored arrays."""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from data_contracts.arrays import array_layouts
from data_contracts.conventions import DISTORTION
from data_contracts.records import ImageLength, Name, Record

Entry = Annotated[float, Field(ge=-1.01, le=1.01)]
"""Entry of a rotation matrix, which may be rounded."""
Vector3 = tuple[Entry, Entry, Entry]

_Bounded = Annotated[float, Field(ge=-1e7, le=1e7)]
_Focal = Annotated[float, Field(gt=0, le=1e7)]

LensName = Literal["brown", "rational", "fisheye"]
"""Brown's model, OpenCV's rational one, or that of Kannala and Brandt, OpenCV's cv2.fisheye."""

LENS_MODELS: Final[tuple[LensName, ...]] = ("brown", "rational", "fisheye")
"""Names of the lens models; stored arrays have their index."""

COEFFICIENTS: Final[dict[LensName, tuple[str, ...]]] = {
    "brown": DISTORTION[:5],
    "rational": DISTORTION,
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Coefficients of each lens model, in OpenCV's order."""


class _Lens(Record):
    """Fields that the records of cameras and of lenses share."""

    id: Name
    image_size: tuple[ImageLength, ImageLength]
    """Width and height [px]."""
    distortion: tuple[_Bounded, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Coefficients of the lens model, in OpenCV's order: k1 k2 p1 p2 k3 of `brown`, with k4 k5 k6
    of `rational`, or k1 k2 k3 k4 of `fisheye` [1]. A fit keeps all but k1, k2 and k3."""
    lens_model: LensName = "brown"
    """Lens model of `distortion`."""

    @model_validator(mode="after")
    def _check_coefficients(self) -> Self:
        names = COEFFICIENTS[self.lens_model]
        if len(self.distortion) != len(names):
            raise ValueError(
                f"distortion: {self.lens_model} has {' '.join(names)}, found "
                f"{len(self.distortion)} numbers"
            )
        return self


class CameraCalibration(_Lens):
    """One calibrated static camera."""

    focal_px: tuple[_Focal, _Focal]
    """fx, fy [px]."""
    principal_point_px: tuple[_Bounded, _Bounded]
    """cx, cy [px]; (0, 0) is the centre of the top-left pixel."""
    rotation: tuple[Vector3, Vector3, Vector3]
    """Rows of R in x_cam = R x_world + t."""
    translation: tuple[_Bounded, _Bounded, _Bounded]
    """t in x_cam = R x_world + t [m]."""


class LensCalibration(_Lens):
    """The lens of a static camera whose pose is not known, with its uncertainty."""

    focal_px: _Focal
    """Focal length for square pixels [px]."""
    principal_point_px: tuple[_Bounded, _Bounded]
    """cx, cy [px]; (0, 0) is the centre of the top-left pixel."""
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
        k1 to k6, p1 and p2 in OpenCV's order; 0 where the lens model lacks one
    lens_model () uint8 [1]:
        0: Brown's k1 k2 p1 p2 k3, 1: rational, with k4 k5 k6, 2: fisheye, with k1 to k4
    rotation (cam_coordinate, coordinate) float64 [1]:
        R in x_cam = R x_world + t
    translation (cam_coordinate) float64 [m]:
        t in x_cam = R x_world + t
    image_size (axis) int64 [px]:
        width, height
    """
)
"""Arrays of one static camera."""
