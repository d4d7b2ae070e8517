"""Unit of length of a calibration: what its file says, what its cameras say; size of its images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.files import read_toml

MILLIMETRE: Final = 1e-3
"""[m]"""


def require_metres(
    path: Path, cameras: Mapping[str, CameraCalibration], unit_m: float = 1.0
) -> None:
    """Raise InputError if the distances of cameras [m] contradict the unit of their file [m]."""
    nearest_m = 0.1  # farthest camera from the middle in a file in mm, at least
    farthest_m = 1000.0  # of a camera from the middle of all: 200 m around a stadium
    centers = np.array([-np.array(each.rotation).T @ each.translation for each in cameras.values()])
    distance = float(np.linalg.norm(centers - centers.mean(axis=0), axis=-1).max())
    in_millimetres = unit_m == MILLIMETRE
    if len(centers) < 2 or (
        distance <= farthest_m and not (in_millimetres and distance < nearest_m)
    ):
        return
    raise InputError(
        f"{path}: translation",
        expected=f"positions in {'millimetres' if in_millimetres else 'metres'}",
        found=f"a camera {distance:.3g} m from the middle of all cameras",
        todo="Multiply the positions by 1000 if they are in metres (worldpose import --unit m)."
        if distance < nearest_m
        else "Divide the positions by 1000 if they are in millimetres (worldpose import --unit "
        "mm).",
    )


def other_middle(principal_point: Sequence[float], size: Sequence[int]) -> str:
    """Return whose middle a principal point is if it is far from that of images of a size; else "".

    Lenses are off along one axis, or differently along both; another size is off alike along both.
    """
    most, alike = 0.4, 0.15  # largest distance, and that along both axes [half sides]
    size_of = 2.0 * np.array(principal_point) + 1.0
    off = size_of / size - 1.0
    if np.abs(off).max() <= most and (np.abs(off).min() <= alike or np.ptp(off) > 0.1):
        return ""
    x, y = (round(each, 1) for each in principal_point)
    return f"{x}, {y}, the middle of about {size_of[0]:.0f} x {size_of[1]:.0f} px"


def doubt_middle(name: str, principal_point: Sequence[float], size: Sequence[int]) -> list[str]:
    """Return a warning about a stated image size whose middle is not near the principal point."""
    found = other_middle(principal_point, size)
    doubt = f"is its size of {size[0]} x {size[1]} px right?"
    return [f"warning: the principal point of {name} is {found}; {doubt}"] if found else []


def require_middle(
    where: str, principal_point: Sequence[float], size: tuple[int, int], todo: str
) -> None:
    """Raise InputError if a lens whose file states no size is not of images of the video's size."""
    if found := other_middle(principal_point, size):
        expected = f"near the middle of the video's {size[0]} x {size[1]} px, as no size is stated"
        raise InputError(f"{where}: principal point", expected, found, todo)


def scaled(
    camera: CameraCalibration,
    scale: float,
    image_size: tuple[int, int],
    bar: NDArray[np.float64] | float = 0.0,
) -> CameraCalibration:
    """Return a camera in images `scale` times as large, perhaps with black bars (2,) [px]."""
    # Pixel centres are whole numbers, so that the picture's corner is at -0.5.
    middle = (np.array(camera.principal_point_px) + 0.5) * scale - 0.5 + bar
    return camera.model_copy(
        update={
            "image_size": image_size,
            "focal_px": tuple(scale * focal for focal in camera.focal_px),
            "principal_point_px": tuple(middle.tolist()),
        }
    )


def toml_unit_m(path: Path, content: Mapping[str, Any] | None = None) -> float:
    """Return the unit of a TOML file [m]: FreeMoCap's is mm; InputError if that has no ground."""
    content = read_toml(path) if content is None else content
    # Keys of `metadata` that FreeMoCap alone writes.
    own = {"charuco_square_size", "charuco_board_object", "groundplane_calibration"}
    own |= {"groundplane_applied", "recording_info", "path_to_recorded_videos"}
    metadata = content.get("metadata")
    if not isinstance(metadata, dict) or not own & metadata.keys():
        return 1.0
    if not (metadata.get("groundplane_calibration") or metadata.get("groundplane_applied")):
        where = f"{path}: metadata.groundplane_calibration"
        expected = "true: the world's z axis points up from the ground"
        todo = "Process the calibration again in FreeMoCap with the board on the ground ('Use "
        todo += "Charuco as groundplane'), or import the lenses (worldpose import --lens) and "
        todo += "locate the cameras from people (worldpose locate-cameras)."
        found = "no ground plane: the world is that of the first camera"
        raise InputError(where, expected, found, todo)
    return MILLIMETRE


def square_focal(focal: Sequence[float], where: str) -> tuple[float, float]:
    """Return the mean of fx and fy [px], and half their difference; InputError if too different."""
    fx, fy = focal
    if abs(fx - fy) > 0.02 * fx:
        expected = "fx and fy of square pixels, within 2 %"
        todo = "Correct the calibration file."
        raise InputError(f"{where}.matrix", expected, f"{fx:g} and {fy:g}", todo)
    return 0.5 * (fx + fy), 0.5 * abs(fx - fy)


def require_optics(
    where: str,
    size: NDArray[np.float64],
    focal: NDArray[np.float64],
    principal_point: NDArray[np.float64],
) -> None:
    """Raise InputError for a focal length or principal point impossible at this image size.

    A principal point in the middle of an image of the exchanged size shows that it is exchanged.
    """
    center_sizes = 10  # of the principal point from the center, in longer sides [1]
    # Minimum and maximum focal length over the image's longer side [1]: a field of view of
    # 168 degrees, and a telescope's of 0.06.
    focal_ratios = (0.05, 1000.0)
    ratio = focal / np.max(size)
    if np.any(ratio < focal_ratios[0]) or np.any(ratio > focal_ratios[1]):
        low, high = (bound * float(np.max(size)) for bound in focal_ratios)
        expected = f"positive pixels, {low:g} to {high:g} for {size[0]:g} x {size[1]:g}"
        todo = "Give it in pixels: focal length in mm / sensor width in mm * image width."
        raise InputError(f"{where}: focal length", expected, str(focal.tolist()), todo)
    if np.any(np.abs(principal_point - size / 2) > center_sizes * np.max(size)):
        expected = f"pixels within {center_sizes} image sizes of the image's centre"
        todo = "Give it in pixels from the image's top-left corner."
        raise InputError(f"{where}: principal point", expected, str(principal_point.tolist()), todo)
    away = [float(np.abs(principal_point / each - 0.5).max()) for each in (size, size[::-1])]
    if away[0] > 0.2 and away[1] < 0.1:
        expected = (
            f"width and height with the principal point {principal_point.tolist()} near the middle"
        )
        found = f"width {size[0]:g} and height {size[1]:g}, which seem to be exchanged"
        raise InputError(f"{where}: size", expected, found, "Exchange them.")
