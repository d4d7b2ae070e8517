"""Reader and writer of calibrated cameras as TOML of Anipose, Pose2Sim and caliscope.

One table per camera with `size`, `matrix`, `distortions` (k1 k2 p1 p2 k3, as OpenCV), `rotation`
(Rodrigues vector [rad], or 3x3) and `translation` [m] of x_cam = R x_world + t. A camera's id is
its `name`, else its table. caliscope's own file has the tables under `cameras`, by number: camera 3
is `cam_3`, as in its Anipose export. The reader ignores `metadata` and further keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.ingest.given_cameras import (
    NUMBER_LIMIT,
    ROTATION_TOLERANCE,
    brief,
    calibration_error,
    cameras_by_name,
    given_camera,
)
from worldpose.ingest.text_files import read_toml


def read_calibration_toml(path: Path) -> dict[str, CameraCalibration]:
    """Return the cameras of a TOML file by name, in file order.

    Raises:
        InputError: with file and key: unreadable, a missing or misshapen entry, not finite, no
            rotation, a fisheye camera, no camera, or two cameras of one name.
    """
    content = read_toml(path)
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) and "size" not in nested else content
    cameras = []
    for key, table in tables.items():
        if key == "metadata":
            continue
        where = f"{path}: {key}" if tables is content else f"{path}: cameras.{key}"
        if not isinstance(table, dict):
            raise calibration_error(where, "a table for each camera", brief(table))
        name = table.get("name", f"cam_{key}" if key.isdecimal() else key)
        cameras.append((where, _toml_camera(where, str(name), table)))
    return cameras_by_name(path, cameras)


def _toml_camera(where: str, name: str, table: Mapping[str, Any]) -> CameraCalibration:
    if table.get("fisheye", False) is not False:
        raise InputError(
            f"{where}.fisheye",
            expected="false: the lens model is OpenCV's k1 k2 p1 p2 k3",
            found=brief(table["fisheye"]),
            todo="Calibrate this camera with the standard model, or undistort its pictures first.",
        )
    matrix = _numbers(table, where, "matrix", (3, 3))
    size = _numbers(table, where, "size", (2,))
    rotation = _rotation(table, where)
    distortion = np.ravel(_numbers(table, where, "distortions", None))
    if len(distortion) not in (4, 5, 8, 12, 14):
        found = f"{len(distortion)} numbers"
        raise calibration_error(f"{where}.distortions", "4 or 5: k1 k2 p1 p2 (k3)", found)
    if np.any(distortion[5:] != 0):
        raise calibration_error(
            f"{where}.distortions",
            "zero beyond the fifth, k3",
            f"{distortion[5:].tolist()}, a lens model with more terms",
        )
    off_diagonal = [matrix[0, 1], matrix[1, 0], *matrix[2, :2], matrix[2, 2] - 1]
    if np.any(np.abs(off_diagonal) > 1e-9):
        raise calibration_error(
            f"{where}.matrix", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", str(matrix.tolist())
        )
    return given_camera(
        where,
        name,
        size=size,
        focal=np.diag(matrix)[:2],
        principal_point=matrix[:2, 2],
        distortion=np.append(distortion, 0.0)[:5],
        rotation=rotation,
        translation=_numbers(table, where, "translation", (3,)),
    )


def _rotation(table: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    given = _numbers(table, where, "rotation", None)
    if given.shape == (3, 3):
        return given
    if given.size != 3:
        raise calibration_error(
            f"{where}.rotation", "3 numbers (Rodrigues vector) or 3x3", f"shape {given.shape}"
        )
    angle = float(np.linalg.norm(given))
    if angle > 2.0 * np.pi + ROTATION_TOLERANCE:
        raise InputError(
            f"{where}.rotation",
            expected="a Rodrigues vector in radians, no longer than 2 pi",
            found=f"one of length {angle:g}",
            todo="If these are degrees, multiply them by pi / 180.",
        )
    matrix: NDArray[np.float64] = Rotation.from_rotvec(given.ravel()).as_matrix()
    return matrix


def _numbers(
    table: Mapping[str, Any], where: str, key: str, shape: tuple[int, ...] | None
) -> NDArray[np.float64]:
    """Return entry `key` as float64; column and row vectors become flat."""
    if key not in table:
        raise InputError(
            f"{where}.{key}",
            expected="a value",
            found="nothing",
            todo="Calibrate this camera, or take it out of the file.",
        )
    numbers = _plain_numbers(table[key])
    if numbers is None:
        raise calibration_error(f"{where}.{key}", "numbers", brief(table[key]))
    if shape is not None and len(shape) == 1 and numbers.size == shape[0]:
        numbers = numbers.ravel()
    if shape is not None and numbers.shape != shape:
        raise calibration_error(
            f"{where}.{key}", f"numbers of shape {shape}", f"shape {numbers.shape}"
        )
    if not np.all(np.abs(numbers) <= NUMBER_LIMIT):  # also NaN
        raise calibration_error(
            f"{where}.{key}", f"finite numbers up to {NUMBER_LIMIT:g}", brief(table[key])
        )
    return numbers


def _plain_numbers(value: object) -> NDArray[np.float64] | None:
    """Return a list, or list of lists, of numbers as an array; None for anything else."""
    rows = value if isinstance(value, list) else [value]
    flat = [x for row in rows for x in (row if isinstance(row, list) else [row])]
    # bool is an int to Python, and numpy would read text as a number.
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in flat):
        return None
    try:
        return np.array(value, dtype=np.float64)
    except (ValueError, OverflowError):
        return None


def write_calibration_toml(path: Path, calibrations: Mapping[str, CameraCalibration]) -> None:
    """Write cameras in the form that Anipose, Pose2Sim and `read_calibration` read.

    Numbers keep all digits. A rotation becomes a Rodrigues vector, the only form that all of them
    read, with rounding errors of 1e-15 on reading.
    """
    lines = []
    for index, (name, camera) in enumerate(calibrations.items()):
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_point_px
        rotvec = Rotation.from_matrix(np.array(camera.rotation)).as_rotvec()
        lines += [
            f"[cam_{index}]",
            f'name = "{name}"',
            f"size = {list(camera.image_size)}",
            f"matrix = {[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]}",
            f"distortions = {list(camera.distortion)}",
            f"rotation = {rotvec.tolist()}",
            f"translation = {list(camera.translation)}",
            "fisheye = false",
            "",
        ]
    lines += ["[metadata]", "adjusted = false", "error = 0.0", ""]
    path.write_text("\n".join(lines), encoding="utf-8")
