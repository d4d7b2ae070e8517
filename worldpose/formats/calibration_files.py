"""Readers and a writer of camera calibrations: TOML, and Qualisys XML (`.qca.txt`).

Reader and writer of calibrated cameras as TOML of Anipose, Pose2Sim and caliscope.

One table per camera with `size`, `matrix`, `distortions` (k1 k2 p1 p2 k3, as OpenCV), `rotation`
(Rodrigues vector [rad], or 3x3) and `translation` [m] of x_cam = R x_world + t. A camera's id is
its `name`, else its table. caliscope's own file has the tables under `cameras`, by number: camera 3
is `cam_3`, as in its Anipose export. The reader ignores `metadata` and further keys.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.files import SETTINGS_BYTES, read_toml, require_file

if TYPE_CHECKING:
    from worldpose.geometry import Camera

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


def build_camera(
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
    require_optics(where, size, focal, principal_point)
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


def require_optics(
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


def index_by_name(
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


def _shorten(value: object) -> str:
    """Return a value shortened for a message."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def read_calibration_toml(path: Path) -> dict[str, CameraCalibration]:
    """Return the cameras of a TOML file by name, in file order.

    Raises:
        InputError: the file is unreadable or has a missing, misshapen or infinite entry, no
            rotation, a fisheye camera, no camera, or two cameras of one name; the error names file
            and key.
    """
    return index_by_name(
        path,
        [
            (where, _read_toml_camera(where, name, table))
            for where, name, table in camera_tables(path)
        ],
    )


def camera_tables(path: Path) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield the place, the camera's id and the table of each camera of a TOML file.

    Raises:
        InputError: the file is unreadable, or has an entry that is no table.
    """
    content = read_toml(path)
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) and "size" not in nested else content
    for key, table in tables.items():
        if key == "metadata":
            continue
        where = f"{path}: {key}" if tables is content else f"{path}: cameras.{key}"
        if not isinstance(table, dict):
            raise calibration_error(where, "a table for each camera", _shorten(table))
        yield where, str(table.get("name", f"cam_{key}" if key.isdecimal() else key)), table


class Optics(NamedTuple):
    """Size, focal lengths and principal point (2,) [px], and distortion (5,) k1 k2 p1 p2 k3."""

    size: NDArray[np.float64]
    focal: NDArray[np.float64]
    principal_point: NDArray[np.float64]
    distortion: NDArray[np.float64]


def read_optics(where: str, table: Mapping[str, Any]) -> Optics:
    """Return size, matrix and distortion of a camera's table.

    Raises:
        InputError: an entry is missing or misshapen, or the lens has another model.
    """
    if table.get("fisheye", False) is not False:
        raise InputError(
            f"{where}.fisheye",
            expected="false: the lens model is OpenCV's k1 k2 p1 p2 k3",
            found=_shorten(table["fisheye"]),
            todo="Calibrate this camera with the standard model, or undistort its pictures first.",
        )
    matrix = _read_numbers(table, where, "matrix", (3, 3))
    size = _read_numbers(table, where, "size", (2,))
    distortion = np.ravel(_read_numbers(table, where, "distortions", None))
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
    return Optics(size, np.diag(matrix)[:2], matrix[:2, 2], np.append(distortion, 0.0)[:5])


def _read_toml_camera(where: str, name: str, table: Mapping[str, Any]) -> CameraCalibration:
    if "matrix" in table and not {"rotation", "translation"} & table.keys():
        raise InputError(
            f"{where}.rotation",
            expected="the pose of the camera, rotation and translation",
            found="a lens alone",
            todo="Import lenses with worldpose import --lens FILE --out MATCH, and click the pose.",
        )
    optics = read_optics(where, table)
    return build_camera(
        where,
        name,
        size=optics.size,
        focal=optics.focal,
        principal_point=optics.principal_point,
        distortion=optics.distortion,
        rotation=_read_rotation(table, where),
        translation=_read_numbers(table, where, "translation", (3,)),
    )


def _read_rotation(table: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    given = _read_numbers(table, where, "rotation", None)
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
    from scipy.spatial.transform import Rotation  # late: it takes 0.1 s, and few rotations are read

    matrix: NDArray[np.float64] = Rotation.from_rotvec(given.ravel()).as_matrix()
    return matrix


def _read_numbers(
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
        raise calibration_error(f"{where}.{key}", "numbers", _shorten(table[key]))
    if shape is not None and len(shape) == 1 and numbers.size == shape[0]:
        numbers = numbers.ravel()
    if shape is not None and numbers.shape != shape:
        raise calibration_error(
            f"{where}.{key}", f"numbers of shape {shape}", f"shape {numbers.shape}"
        )
    if not np.all(np.abs(numbers) <= NUMBER_LIMIT):  # also NaN
        raise calibration_error(
            f"{where}.{key}", f"finite numbers up to {NUMBER_LIMIT:g}", _shorten(table[key])
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
    from scipy.spatial.transform import Rotation  # late: as above

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


def read_calibration_qualisys(path: Path) -> dict[str, CameraCalibration]:
    """Return the active cameras of a Qualisys calibration by serial, in file order.

    Raises:
        InputError: the file is unreadable, or has a missing attribute, no finite number, no
            rotation, no camera, or two cameras of one serial; the error names file, camera and
            attribute.
    """
    size = require_file(path)
    if size > SETTINGS_BYTES:
        raise calibration_error(str(path), f"at most {SETTINGS_BYTES} bytes", f"{size} bytes")
    try:
        root = ET.fromstring(path.read_bytes(), ET.XMLParser(target=_PlainTree()))
    except (ET.ParseError, ValueError, LookupError, OSError) as error:
        raise calibration_error(str(path), "Qualisys XML", str(error)) from error
    cameras = []
    for index, element in enumerate(root.iterfind("cameras/camera")):
        where = f"{path}: camera[{index}]"
        if element.get("active", "1") != "0":
            cameras.append((where, _read_qualisys_camera(where, element)))
    return index_by_name(path, cameras)


class _PlainTree(ET.TreeBuilder):
    """A tree builder that rejects entities, which could expand a small file without limit."""

    def doctype(self, name: str, pubid: str, system: str) -> None:
        raise ValueError(f"a DOCTYPE ({name}), which no calibration has")


def _read_qualisys_camera(where: str, element: ET.Element) -> CameraCalibration:
    """Return one `<camera>` of a Qualisys calibration, with its `serial` as name.

    `<transform>`: x y z is the camera centre C [mm]; r11..r33 is A, row by row, whose rows are the
    camera's axes in the world: x right, y up, z backward. So R = diag(1, -1, -1) A, t = -R C.

    `<intrinsic>`: focal length and centre point are in 1/64 px of the sensor; `<fov_video>` (px,
    both ends included) is the part of the sensor in the video. The radial and tangential (in the
    file: tangental) coefficients act on the normalised image plane and have no unit, so that they
    need no conversion: only lengths on the sensor are in 1/64 px. (Pose2Sim's reader divides them
    by 64 as well, which nearly removes the distortion.) `viewrotation` rotates only the view in
    QTM; the function ignores it.
    """
    parts = {}
    for tag in ("transform", "intrinsic", "fov_video"):
        part = element.find(tag)
        if part is None:
            raise calibration_error(where, f"<{tag}>", "nothing")
        parts[tag] = part

    def read(tag: str, *keys: str) -> NDArray[np.float64]:
        values = []
        for key in keys:
            text = parts[tag].get(key)
            try:
                values.append(float(text if text is not None else "nothing"))
            except ValueError as error:
                raise calibration_error(f"{where}.{tag}.{key}", "a number", repr(text)) from error
            if not abs(values[-1]) <= NUMBER_LIMIT:
                raise calibration_error(
                    f"{where}.{tag}.{key}", f"up to {NUMBER_LIMIT:g}", repr(text)
                )
        return np.array(values)

    left, top, right, bottom = read("fov_video", "left", "top", "right", "bottom")
    skew = parts["intrinsic"].get("skew", "0")
    if skew.strip("0.+-") != "":
        raise calibration_error(f"{where}.intrinsic.skew", "0", repr(skew))
    axes = read("transform", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(3, 3)
    center = read("transform", "x", "y", "z") / 1000.0
    rotation = np.diag([1.0, -1.0, -1.0]) @ axes
    k1, k2, k3 = read("intrinsic", "radialDistortion1", "radialDistortion2", "radialDistortion3")
    p1, p2 = read("intrinsic", "tangentalDistortion1", "tangentalDistortion2")
    return build_camera(
        where,
        element.get("serial", ""),
        size=np.array([right - left + 1, bottom - top + 1]),
        focal=read("intrinsic", "focalLengthU", "focalLengthV") / 64.0,
        principal_point=read("intrinsic", "centerPointU", "centerPointV") / 64.0 - [left, top],
        distortion=np.array([k1, k2, p1, p2, k3]),
        rotation=rotation,
        translation=-rotation @ center,
    )


def read_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Return the cameras of a calibration file by name, in file order.

    Args:
        path: file as in `read_calibration`.

    Raises:
        InputError: an unknown file type, or an invalid entry, with file and key.
    """
    from worldpose.geometry import Camera  # late: most commands only check calibrations

    given = read_calibration(Path(path))
    return {name: Camera.from_calibration(calibration) for name, calibration in given.items()}


def read_calibration(path: Path) -> dict[str, CameraCalibration]:
    """Return the cameras of a calibration file by name, in file order.

    Args:
        path: `.toml` of Anipose, Pose2Sim or caliscope (`read_calibration_toml`); `.txt` or `.xml`
            of Qualisys (`read_calibration_qualisys`).

    Raises:
        InputError: an unknown file type, or an invalid entry, with file and key.
    """
    if path.suffix.lower() == ".toml":
        return read_calibration_toml(path)
    if path.suffix.lower() in (".txt", ".xml"):
        return read_calibration_qualisys(path)
    raise InputError(
        str(path),
        expected="a calibration: .toml (Anipose, Pose2Sim, caliscope) or .qca.txt (Qualisys)",
        found=f"a file that ends in {path.suffix!r}",
        todo="Export the calibration in one of these forms.",
    )
