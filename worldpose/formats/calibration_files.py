"""Cameras of a calibration file: checks that all forms share, and Anipose's TOML.

Reader of calibrated cameras as TOML of Anipose, Pose2Sim, caliscope and FreeMoCap; the
other forms are in `calibration_systems` and `calibration_forms`.

One table per camera with `size`, `matrix`, `distortions` (as OpenCV: k1 k2 p1 p2 k3, with k4 k5 k6,
or k1 k2 k3 k4 where `fisheye` is true), `rotation` (Rodrigues vector [rad], or 3x3) and
`translation` [m] of x_cam = R x_world + t. A camera's id is its `name`, else its table. caliscope's
own file has the tables under `cameras`, by number: camera 3 is `cam_3`, as in its Anipose export.
FreeMoCap's file, known by its `metadata`, is in millimetres.
The reader ignores further keys.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from data_contracts.cameras import COEFFICIENTS, CameraCalibration, LensName
from worldpose.errors import InputError, describe_value
from worldpose.formats.calibration_unit import require_optics, toml_unit_m
from worldpose.formats.files import read_toml

NUMBER_LIMIT: Final = 1e9
"""Maximum absolute value of any entry, whatever its unit."""

ROTATION_TOLERANCE: Final = 1e-4
"""Maximum rounding error of R R^T = I [1]; four decimals give less."""


class LeftOut(dict[str, str]):
    """Reasons why cameras are left out, by camera; `notes` are sentences about the others."""

    def __init__(self) -> None:
        super().__init__()
        self.notes: list[str] = []


class Optics(NamedTuple):
    """Size, focal lengths and principal point (2,) [px], coefficients and their lens model."""

    size: NDArray[np.float64]
    focal: NDArray[np.float64]
    principal_point: NDArray[np.float64]
    distortion: NDArray[np.float64]
    lens_model: LensName = "brown"


def build_camera(
    where: str,
    name: str,
    optics: Optics,
    *,
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
) -> CameraCalibration:
    """Return the camera record; a rounded matrix becomes the nearest rotation.

    `where` is file and camera. x_cam = R x_world + t has R (3, 3) and t (3,) [m]. InputError for a
    bad size, focal length or rotation, and for a name unfit for a file.
    """
    distance_limit = 1e7  # maximum coordinate of a translation [m]
    size_limit = 1 << 16  # of an image [px]; OpenCV's own for most operations
    size, focal, principal_point, distortion, lens_model = optics
    if np.any(size < 1) or np.any(size > size_limit) or np.any(size != np.round(size)):
        expected = f"whole pixels from 1 to {size_limit}; an import with --videos takes theirs"
        raise calibration_error(f"{where}: size", expected, str(size.tolist()))
    require_optics(where, size, focal, principal_point)
    far = float(np.max(np.abs(translation)))
    if far > distance_limit:
        raise calibration_error(
            f"{where}: translation", f"metres, at most {distance_limit:g}", f"{far:g}"
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
            id=camera_id(name),
            image_size=(int(size[0]), int(size[1])),
            focal_px=tuple(focal.tolist()),
            principal_point_px=tuple(principal_point.tolist()),
            distortion=tuple(distortion.tolist()),
            lens_model=lens_model,
            rotation=tuple(tuple(row) for row in rotation.tolist()),
            translation=tuple(translation.tolist()),
        )
    except ValidationError as invalid:
        raise calibration_error(
            f"{where}: name", "up to 64 letters, digits and . _ -, none of . _ - first", repr(name)
        ) from invalid


def camera_id(name: str) -> str:
    """Return the id of a camera that a file or a calibration calls by any name.

    Accents are dropped, and hyphens stand for characters that ids do not allow: "Südtribüne 1" is
    Sudtribune-1. A path stays as it is, to be refused, and so does a name of other letters alone.
    """
    if re.search(r"[/\\]", name):
        return name
    letters = unicodedata.normalize("NFKD", name)
    plain = "".join(letter for letter in letters if not unicodedata.combining(letter))
    return re.sub(r"[^A-Za-z0-9._-]+", "-", plain).strip("-._") or name


def known_id(name: str, known: Collection[str]) -> str:
    """Return the id among `known` of a camera of a name, or else the name's own id.

    Some programs change capitals, or write underscores for spaces, where ids have hyphens.
    """
    own = camera_id(name).replace("_", "-").lower()
    alike = [each for each in known if each.replace("_", "-").lower() == own]
    return name if name in known else alike[0] if len(alike) == 1 else camera_id(name)


def index_by_name(
    path: Path, cameras: list[tuple[str, CameraCalibration]]
) -> dict[str, CameraCalibration]:
    """Return cameras by id, in file order; InputError for none, two of one name, or no pose."""
    by_name: dict[str, CameraCalibration] = {}
    for where, camera in cameras:
        if camera.id in by_name:
            raise calibration_error(where, "a name of its own", f"{camera.id!r} a second time")
        by_name[camera.id] = camera
    if not by_name:
        raise calibration_error(str(path), "at least one camera", "none")
    require_poses(path, by_name)
    return by_name


def require_poses(path: Path, cameras: Mapping[str, CameraCalibration]) -> None:
    """Raise InputError if several cameras are all in one place, or the only one has no pose."""
    centers = np.array([-np.array(each.rotation).T @ each.translation for each in cameras.values()])
    is_lens = all(np.array_equal(each.rotation, np.eye(3)) for each in cameras.values())
    at_one = np.ptp(centers, axis=0).max() <= 1e-6 * np.abs(centers).max()
    if at_one and (len(cameras) > 1 or (is_lens and not centers.any())):
        found = "all cameras in one place" if len(cameras) > 1 else "one camera, at the origin"
        found += ": a calibration before the poses were found"
        todo = "Import its lenses with worldpose import --lens FILE --out MATCH, and locate the "
        todo += "cameras by clicks or by worldpose locate-cameras."
        raise InputError(f"{path}: translation", "the poses of the cameras", found, todo)


def calibration_error(where: str, expected: str, found: str) -> InputError:
    """Return the error for an entry of a calibration file."""
    return InputError(where, expected=expected, found=found, todo="Correct the calibration file.")


def read_calibration_toml(
    path: Path,
    left_out: LeftOut | None = None,
    sizes: Mapping[str, tuple[int, int]] = MappingProxyType({}),
) -> dict[str, CameraCalibration]:
    """Return the cameras of a TOML file by name, in file order.

    `left_out` receives cameras without a pose; None = all must have one. `sizes`, width and height
    [px] of videos, serve files whose size is no whole number: programs that do not know it write
    twice the principal point. InputError also if the world of FreeMoCap is not that of the ground.
    """
    content = read_toml(path)
    unit_m = toml_unit_m(path, content)
    tables = list(camera_tables(path, content))
    posed = [each for each in tables if not _lacks_pose(each[2])]
    if left_out is not None and posed:
        for _, name, table in tables:
            if _lacks_pose(table):
                half = [key for key in ("rotation", "translation") if not table.get(key)]
                what = half[0] if len(half) == 1 else "pose"
                left_out[camera_id(name)] = f"it has no {what}"
        tables = posed
    cameras = []
    for where, name, given in tables:
        table = _with_size(given, sizes.get(known_id(name, sizes)))
        if _has_lens_alone(table):
            expected = "the pose of the camera, rotation and translation"
            todo = "Import lenses with worldpose import --lens FILE --out MATCH, and click the "
            todo += "pose."
            raise InputError(f"{where}.rotation", expected, "a lens alone", todo)
        cameras.append((where, read_camera_table(where, name, table, unit_m=unit_m)))
    return index_by_name(path, cameras)


def _with_size(table: Mapping[str, Any], size: tuple[int, int] | None) -> Mapping[str, Any]:
    """Return a camera's table, with the video's size if its own is near that, but not whole."""
    given = plain_numbers(table.get("size"))
    if size is None or given is None or given.shape != (2,) or np.all(given == np.round(given)):
        return table
    near = np.all(np.abs(given / np.array(size) - 1.0) < 0.05)
    return {**table, "size": list(size)} if near else table


def _has_lens_alone(table: Mapping[str, Any], lacks: Callable[[list[bool]], bool] = all) -> bool:
    """Return whether a camera has a lens but no pose, or not `all` or `any` of its two parts."""
    pose = [table.get(key) for key in ("rotation", "translation")]
    return "matrix" in table and lacks([each in (None, "null", "None", "", []) for each in pose])


def _lacks_pose(table: Mapping[str, Any]) -> bool:
    """Return whether a camera has a lens but half a pose at most, or one with NaN."""
    pose = repr([table.get(key) for key in ("rotation", "translation")])
    return _has_lens_alone(table, any) or ("matrix" in table and "nan" in pose)


def camera_tables(
    path: Path, content: Mapping[str, Any] | None = None
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield place, id and table of each camera of a TOML file; InputError if an entry is none."""
    content = read_toml(path) if content is None else content
    nested = content.get("cameras")
    tables = nested if isinstance(nested, dict) and "size" not in nested else content
    entries = {"size", "matrix", "distortions", "rotation", "translation"}
    known = [each for each in tables.values() if isinstance(each, dict) and entries & each.keys()]
    for key, table in tables.items():
        is_camera = isinstance(table, dict) and entries & table.keys()
        if key == "metadata" or (known and not is_camera) or re.fullmatch(r"stereo_\d+_\d+", key):
            continue  # caliscope's settings and poses of pairs stand beside its cameras
        where = f"{path}: {key}" if tables is content else f"{path}: cameras.{key}"
        if not isinstance(table, dict):
            raise calibration_error(where, "a table for each camera", describe_value(table))
        yield where, str(table.get("name", f"cam_{key}" if key.isdecimal() else key)), table


class Keys(NamedTuple):
    """Names of a camera's entries in a form; the defaults are Anipose's."""

    size: str = "size"
    matrix: str = "matrix"
    distortions: str = "distortions"
    rotation: str = "rotation"
    translation: str = "translation"


def read_optics(where: str, table: Mapping[str, Any], keys: Keys = Keys()) -> Optics:  # noqa: B008
    """Return the optics of a camera's table, by a form's names; InputError if an entry is wrong."""
    matrix = _read_numbers(table, where, keys.matrix, (3, 3))
    size = _read_numbers(table, where, keys.size, (2,))
    numbers = np.ravel(_read_numbers(table, where, keys.distortions, None))
    said = read_model(where, table)
    distortion, model = _read_lens(f"{where}.{keys.distortions}", numbers, *said)
    off_diagonal = [matrix[0, 1], matrix[1, 0], *matrix[2, :2], matrix[2, 2] - 1]
    if np.any(np.abs(off_diagonal) > 1e-9):
        raise calibration_error(
            f"{where}.{keys.matrix}", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", str(matrix.tolist())
        )
    return Optics(size, np.diag(matrix)[:2], matrix[:2, 2], distortion, model)


MODEL_NAMES: Final = (
    *("fisheye", "fisheyemodel", "distortionmodel", "distortiontype", "modeltype"),
    *("projectionmodel", "projection", "lensmodel", "model", "cameramodel", "cameratype", "type"),
)
"""Names of entries that may name the lens model; the last six may be something else as well."""
FISHEYE_WORDS: Final = (
    *("1", "1.0", "true", "fisheye", "equidistant", "equi", "kannala_brandt", "opencv_fisheye"),
    *("pinhole_equi", "kb4"),
)
OTHER_WORDS: Final = (
    *("0", "0.0", "false", "plumb_bob", "radtan", "brown", "pinhole", "opencv", "standard"),
    *("rational_polynomial", "rational", "full_opencv", "none", "perspective", "thin_prism"),
    *("tilted", "brown_conrady", "pinhole_radtan", "simple_radial", "radial", "simple_pinhole"),
    *("radial_tangential", "radialtangential", "brown3t2", "polynomial"),
)
"""Values of `MODEL_NAMES`, in lower case with underscores; coefficients tell these apart."""


def plain_key(key: str) -> str:
    """Return a name without underscores and capitals, which do not matter in longer ones."""
    return key if len(key) == 1 else key.replace("_", "").lower()


def tells_model(key: str) -> bool:
    """Return whether an entry's name is one of a lens model, or of what may name one."""
    others = r"lens(name|type|projection)?|(is|use)?fisheye(lens)?|calib(ration)?model"
    others += "|(model|projection)(name|type)|calib(ration)?type"
    plain = plain_key(key)
    return plain in MODEL_NAMES or re.fullmatch(others, plain) is not None


def read_model(where: str, given: Mapping[str, Any]) -> tuple[bool, bool]:
    """Return whether a lens's entries say, under any usual name, a fisheye, or a word of one order.

    InputError if one names another lens model than those of OpenCV, or two contradict.
    """
    # Names of lens models, and parts of them, which names of devices do not have.
    lens_part = r"fish|omnidir|equidist|equisolid|kannala|(?<!a)spher|division|polynom|radial"
    lens_part += (
        r"|ographic|lensmodel|^(pinhole_)?(omni|equi|e?ucm|fov|mei|poly\d*|ds|eq)(_none|_radtan)?$"
    )
    said = {}
    for key in filter(tells_model, given):
        plain, values = plain_key(key), np.ravel(np.asarray(given[key], object))
        is_word = len(values) == 1 and isinstance(values[0], str | int | float | None)
        word = re.sub(r"[ -]+", "_", str(values[0] if is_word else given[key]).lower())
        is_other = not is_word or not re.search(lens_part, word)
        # Of entries of other names, such as lens or is_fisheye, a number tells the last alone.
        first = 0 if plain in MODEL_NAMES or "fisheye" in plain else 3
        if word in FISHEYE_WORDS[first:] + OTHER_WORDS[first:]:
            said[word] = key
        elif plain in MODEL_NAMES[:-6] or not is_other:
            words = ", ".join((*OTHER_WORDS[3:], *FISHEYE_WORDS[3:]))
            raise calibration_error(f"{where}: {key}", f"one of {words}", f"{word!r:.60}")
    yes = said.keys() & set(FISHEYE_WORDS)
    no = said.keys() & set(OTHER_WORDS) - {"pinhole", "none", "opencv", "standard"}
    if yes and no:
        found = ", ".join(f"{key} {word}" for word, key in said.items())
        raise calibration_error(where, "one lens model", found)
    return bool(yes), bool(no & {"plumb_bob", "radtan", "pinhole_radtan", "rational_polynomial"})


def _read_lens(
    where: str, numbers: NDArray[np.float64], fisheye: bool, is_ordered: bool
) -> tuple[NDArray[np.float64], LensName]:
    """Return coefficients in OpenCV's order, and their model; OpenCV writes up to 14 numbers."""
    # Maximum p1 and p2 [1]; real lenses have 0.005, webcams up to 0.02. Four numbers name no k3.
    # Poor calibrations reach 0.07: their k3 is larger than what another order has in its place.
    k3, p = (np.abs(each).max(initial=0.0) for each in (numbers[4:5], numbers[2:4]))
    max_tangential = 0.1 if is_ordered or k3 > p else 0.01 if len(numbers) == 4 else 0.025
    is_rational = not fisheye and bool(np.any(numbers[5:8] != 0))
    model: LensName = "fisheye" if fisheye else "rational" if is_rational else "brown"
    names = COEFFICIENTS[model]
    if len(numbers) not in (4, 5, 8, 12, 14) or np.any(numbers[len(names) :] != 0):
        raise calibration_error(
            where,
            "k1 k2 k3 k4 of a fisheye" if fisheye else "k1 k2 p1 p2, with k3, or with k3 k4 k5 k6",
            f"{len(numbers)} numbers{', a lens model with more terms' * (len(numbers) > 5)}",
        )
    if not fisheye and p > max_tangential:
        expected = f"k1 k2 p1 p2 k3 with p1 and p2 up to {max_tangential:g}"
        todo = "If this is k1 k2 k3 k4 of a fisheye, say so in the file: fisheye = true in TOML, "
        todo += "fisheye_model: 1 in others. If it is k1 k2 k3 p1 p2, move k3 to the end. If it is "
        todo += "right, name its model: distortion_model = plumb_bob."
        raise InputError(where, expected, str(numbers.tolist()), todo)
    return np.append(numbers, 0.0)[: len(names)], model


def read_camera_table(
    where: str,
    name: str,
    table: Mapping[str, Any],
    *,
    keys: Keys = Keys(),  # noqa: B008
    unit_m: float = 1.0,
    axes: NDArray[np.float64] | None = None,
    where_pose: str | None = None,
) -> CameraCalibration:
    """Return the camera `name` of a table with the form's `keys` and translations in `unit_m` [m].

    `where`, and `where_pose` if that is in another file, are file and camera for messages; `axes`
    (3, 3) is the rotation A from the world of the file to one with z up, x' = A x; None = none.
    """
    optics = read_optics(where, table, keys)
    where_pose = where if where_pose is None else where_pose
    rotation = _read_rotation(table, where_pose, keys.rotation)
    translation = unit_m * _read_numbers(table, where_pose, keys.translation, (3,))
    return build_camera(
        where,
        name,
        optics,
        rotation=rotation if axes is None else rotation @ axes.T,
        translation=translation,
    )


def _read_rotation(table: Mapping[str, Any], where: str, key: str) -> NDArray[np.float64]:
    given = _read_numbers(table, where, key, None)
    if given.shape == (3, 3):
        return given
    if given.size != 3:
        raise calibration_error(
            f"{where}.{key}", "3 numbers (Rodrigues vector) or 3x3", f"shape {given.shape}"
        )
    angle = float(np.linalg.norm(given))
    if angle > 2.0 * np.pi + ROTATION_TOLERANCE:
        expected = "a Rodrigues vector in radians, no longer than 2 pi"
        todo = "If these are degrees, multiply them by pi / 180."
        raise InputError(f"{where}.{key}", expected, f"one of length {angle:g}", todo)
    from scipy.spatial.transform import Rotation  # late: it takes 0.1 s, and few rotations are read

    matrix: NDArray[np.float64] = Rotation.from_rotvec(given.ravel()).as_matrix()
    return matrix


def _read_numbers(
    table: Mapping[str, Any], where: str, key: str, shape: tuple[int, ...] | None
) -> NDArray[np.float64]:
    """Return entry `key` as float64; column and row vectors become flat."""
    if key not in table:
        todo = "Calibrate this camera, or take it out of the file."
        found = f"nothing; there are {', '.join(map(str, table)):.100}"
        raise InputError(f"{where}.{key}", "a value", found, todo)
    numbers = plain_numbers(table[key])
    if numbers is None:
        raise calibration_error(f"{where}.{key}", "numbers", describe_value(table[key]))
    if shape is not None and len(shape) == 1 and numbers.size == shape[0]:
        numbers = numbers.ravel()
    if shape is not None and numbers.shape != shape:
        raise calibration_error(
            f"{where}.{key}", f"numbers of shape {shape}", f"shape {numbers.shape}"
        )
    if not np.all(np.abs(numbers) <= NUMBER_LIMIT):  # also NaN
        raise calibration_error(
            f"{where}.{key}", f"finite numbers up to {NUMBER_LIMIT:g}", describe_value(table[key])
        )
    return numbers


def plain_numbers(value: object) -> NDArray[np.float64] | None:
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
