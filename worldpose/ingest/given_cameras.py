"""Validation of cameras calibrated by other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError

SIZE_LIMIT: Final = 1 << 16
"""Maximum width and height of an image [px]; OpenCV's own limit for most operations."""

NUMBER_LIMIT: Final = 1e9
"""Maximum absolute value of any entry, whatever its unit."""

FOCAL_RATIOS: Final = (0.05, 1000.0)
"""Minimum and maximum focal length over the image's longer side [1]: a field of view of 168
degrees, and a telescope's of 0.06."""

CENTER_SIZES: Final = 10
"""Maximum distance of the principal point from the image center, in longer sides of the image [1]:
a small crop of a large sensor has an offset of a few."""

DISTANCE_LIMIT: Final = 1e7
"""Maximum coordinate of a translation [m]: from the Earth's equator to its pole."""

ROTATION_TOLERANCE: Final = 1e-4
"""Maximum rounding error of R R^T = I [1]; four decimals give less."""


def given_camera(
    where: str,
    name: str,
    *,
    size: NDArray[np.float64],
    focal: NDArray[np.float64],
    principal_point: NDArray[np.float64],
    distortion: NDArray[np.float64],
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
) -> CameraCalibration:
    """Return the camera record; a rounded matrix becomes the nearest rotation.

    Args:
        where: file and camera, for messages.
        name: id of the camera.
        size: width and height [px].
        focal: fx, fy [px].
        principal_point: cx, cy [px].
        distortion: k1, k2, p1, p2, k3 [1].
        rotation: (3, 3), R in x_cam = R x_world + t.
        translation: t [m].

    Raises:
        InputError: the size is not whole, a focal length is not positive, the matrix is no
            rotation, or the name is unfit for a file.
    """
    if np.any(size < 1) or np.any(size > SIZE_LIMIT) or np.any(size != np.round(size)):
        raise calibration_error(
            f"{where}: size", f"whole pixels from 1 to {SIZE_LIMIT}", str(size.tolist())
        )
    _require_optics(where, size, focal, principal_point)
    far = float(np.max(np.abs(translation)))
    if far > DISTANCE_LIMIT:
        raise calibration_error(
            f"{where}: translation", f"metres, at most {DISTANCE_LIMIT:g}", f"{far:g}"
        )
    error = float(np.max(np.abs(rotation @ rotation.T - np.eye(3))))
    if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        kind = "a mirror image" if error <= ROTATION_TOLERANCE else f"R R^T off by {error:.2g}"
        raise calibration_error(
            f"{where}: rotation", "a rotation: orthonormal, determinant 1", kind
        )
    if error > 1e-12:  # rounded in the file: take the nearest rotation
        u, _, vt = np.linalg.svd(rotation)
        rotation = u @ vt
    try:
        return CameraCalibration(
            id=name,
            image_size=(int(size[0]), int(size[1])),
            focal_px=tuple(focal.tolist()),
            principal_point_px=tuple(principal_point.tolist()),
            distortion=tuple(distortion.tolist()),
            rotation=tuple(tuple(row) for row in rotation.tolist()),
            translation=tuple(translation.tolist()),
        )
    except ValidationError as invalid:
        raise calibration_error(
            f"{where}: name", "up to 64 letters, digits and . _ -, none of . _ - first", repr(name)
        ) from invalid


def _require_optics(
    where: str,
    size: NDArray[np.float64],
    focal: NDArray[np.float64],
    principal_point: NDArray[np.float64],
) -> None:
    """Raise InputError for a focal length or principal point impossible at this image size."""
    ratio = focal / np.max(size)
    if np.any(ratio < FOCAL_RATIOS[0]) or np.any(ratio > FOCAL_RATIOS[1]):
        low, high = (bound * float(np.max(size)) for bound in FOCAL_RATIOS)
        raise InputError(
            f"{where}: focal length",
            expected=f"positive pixels, {low:g} to {high:g} for {size[0]:g} x {size[1]:g}",
            found=str(focal.tolist()),
            todo="Give it in pixels: focal length in mm / sensor width in mm * image width.",
        )
    if np.any(np.abs(principal_point - size / 2) > CENTER_SIZES * np.max(size)):
        raise InputError(
            f"{where}: principal point",
            expected=f"pixels within {CENTER_SIZES} image sizes of the image's centre",
            found=str(principal_point.tolist()),
            todo="Give it in pixels from the image's top-left corner.",
        )


def cameras_by_name(
    path: Path, cameras: list[tuple[str, CameraCalibration]]
) -> dict[str, CameraCalibration]:
    """Return the cameras by id, in file order.

    Args:
        path: the file, for messages.
        cameras: pairs of place in the file and camera.

    Raises:
        InputError: there is no camera, or two cameras have one name.
    """
    by_name: dict[str, CameraCalibration] = {}
    for where, camera in cameras:
        if camera.id in by_name:
            raise calibration_error(where, "a name of its own", f"{camera.id!r} a second time")
        by_name[camera.id] = camera
    if not by_name:
        raise calibration_error(str(path), "at least one camera", "none")
    return by_name


def calibration_error(where: str, expected: str, found: str) -> InputError:
    """Return the error for an entry of a calibration file."""
    return InputError(where, expected=expected, found=found, todo="Correct the calibration file.")


def brief(value: object) -> str:
    """Return a value shortened for a message."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
