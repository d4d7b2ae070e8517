"""Calibrations of programs that count from the first camera, and of Panoptic Studio.

Kalibr's camchain (YAML), multical's and Panoptic Studio's JSON, and OpenPose's XML, one file for
each camera. All poses are x_cam = R x_world + t.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError
from worldpose.formats.calibration_files import (
    Keys,
    LeftOut,
    calibration_error,
    camera_id,
    index_by_name,
    known_id,
    plain_numbers,
    read_camera_table,
)
from worldpose.formats.calibration_unit import require_middle
from worldpose.formats.files import SETTINGS_BYTES, read_json, read_yaml
from worldpose.formats.lens_files import kalibr_tables
from worldpose.formats.opencv_storage import is_storage, read_file_storage

_JSON_BYTES: Final = 16 * SETTINGS_BYTES
_CENTIMETRE: Final = 1e-2
"""[m]"""


def read_camera_json(path: Path, left_out: LeftOut | None) -> dict[str, CameraCalibration]:
    """Return the cameras of Panoptic Studio, multical or a plain mapping by name; or InputError.

    A plain mapping has `K`, `R`, `t` [m], `dist` and `image_size` of each camera, as OpenCV's.
    """
    content = read_json(path, _JSON_BYTES)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if isinstance(cameras, list) and all(isinstance(one, dict) for one in cameras):
        return _read_panoptic(path, cameras, left_out)
    if isinstance(cameras, dict) and all(isinstance(one, dict) for one in cameras.values()):
        return _read_multical(path, cameras, content.get("camera_poses"), left_out)
    if isinstance(content, dict) and cameras is None and content:
        tables = {name: one for name, one in content.items() if isinstance(one, dict)}
        if len(tables) == len(content) and all("K" in one for one in tables.values()):
            shift = "t" if any("t" in one for one in tables.values()) else "T"
            keys = Keys("image_size", "K", "dist", "R", shift)
            return _read_tables(path, tables, keys, left_out)
    raise calibration_error(
        f"{path}: cameras",
        "Panoptic Studio's list of cameras, multical's mapping, or K, R and t of each camera",
        f"nothing; there are {', '.join(content):.80}"
        if isinstance(content, dict) and cameras is None
        else f"{cameras or content!r:.60}",
    )


def json_unit_m(path: Path) -> float:
    """Return the unit of a file that `read_camera_json` reads [m]: Panoptic Studio's is cm."""
    content = read_json(path, _JSON_BYTES)
    is_panoptic = isinstance(content, dict) and isinstance(content.get("cameras"), list)
    return _CENTIMETRE if is_panoptic else 1.0


def _read_panoptic(
    path: Path, cameras: list[dict[str, Any]], left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return cameras with `resolution`, `K`, `distCoef`, `R`, `t` [cm], in a world with y down.

    The many cameras of low resolution have a skew, and are left out.
    """
    keys = Keys("resolution", "K", "distCoef", "R", "t")
    lacks = [_panoptic_lack(table) for table in cameras]
    found = []
    # (3, 3) from a world with y down to one with z up: x stays, y becomes z, z becomes minus y.
    y_down = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for index, table in enumerate(cameras):
        where = f"{path}: cameras[{index}]"
        name = str(table.get("name", ""))
        if left_out is not None and lacks[index] and not all(lacks):
            left_out[camera_id(name)] = lacks[index]
            continue
        camera = read_camera_table(
            where, name, table, keys=keys, unit_m=_CENTIMETRE, axes=y_down, where_pose=where
        )
        found.append((where, camera))
    return index_by_name(path, found)


def _panoptic_lack(table: Mapping[str, Any]) -> str:
    """Return why a camera is left out; empty if it is not."""
    if not table.get("R") and not table.get("t"):
        return "it has no pose"
    matrix = plain_numbers(table.get("K"))  # the reader names its faults
    is_skew = matrix is not None and matrix.shape == (3, 3) and abs(matrix[0, 1]) > 1e-9
    return "its pixels are skew (K[0][1]), which no lens model has" if is_skew else ""


def _read_multical(
    path: Path, cameras: dict[str, dict[str, Any]], poses: object, left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return cameras with `image_size`, `K`, `dist`; the pose of `b` from `a` is called `b_to_a`.

    The world is that of the one camera from which the others are counted, perhaps step by step:
    x_b = R x_a + t, and so on to the first.
    """
    where = f"{path}: camera_poses"
    given = {str(key): pose for key, pose in poses.items()} if isinstance(poses, dict) else {}
    parts = {key: ("",) if key in cameras else key.partition("_to_")[2:] for key in given}
    # Poses of cameras that the file does not list count for none.
    parts = {
        key: part for key, part in parts.items() if key.removesuffix(f"_to_{part[0]}") in cameras
    }
    steps = {key.removesuffix(f"_to_{before}"): before for key, (before,) in parts.items()}
    tables = {name: dict(table) for name, table in cameras.items()}
    for key, (before,) in parts.items():
        name, pose = key.removesuffix(f"_to_{before}"), given[key]
        tables[name].update(pose if isinstance(pose, dict) else {})
    origins = dict.fromkeys(each for each in steps.values() if each not in ("", *steps))
    origins |= dict.fromkeys(name for name, before in steps.items() if before == name)
    for name in origins:
        tables.get(name, {}).update(R=np.eye(3).tolist(), T=[0.0] * 3)
    own = [name for name, before in steps.items() if not before]
    if len(origins) > 1 or (own and origins):
        found = f"poses counted from {', '.join([*own, *origins])}"
        raise calibration_error(where, "poses counted from one of the cameras", found)
    keys = Keys("image_size", "K", "dist", "R", "T")
    read = _read_tables(path, {name: tables[name] for name in cameras}, keys, left_out)

    def place(name: str, passed: tuple[str, ...] = ()) -> CameraCalibration:
        camera, before = read[camera_id(name)], steps.get(name, "")
        if not before or before in origins:
            return camera
        if before in passed or camera_id(before) not in read:
            found = " from ".join((*passed, name, before))
            raise calibration_error(where, "poses counted from one of the cameras", found)
        first, step = place(before, (*passed, name)), np.array(camera.rotation)
        turn, move = step @ first.rotation, step @ first.translation + camera.translation
        pose = {"rotation": tuple(map(tuple, turn.tolist())), "translation": tuple(move.tolist())}
        return camera.model_copy(update=pose)

    placed = {camera_id(name): place(name) for name in cameras if camera_id(name) in read}
    return index_by_name(path, [(f"{path}: {name}", each) for name, each in placed.items()])


def read_kalibr(path: Path, left_out: LeftOut | None) -> dict[str, CameraCalibration]:
    """Return the cameras of a Kalibr camchain, in the world of its first one [m]; or InputError."""
    if is_storage(path):
        expected = "a camchain of Kalibr, or intri.yml with extri.yml of EasyMocap"
        todo = "Import the lenses with worldpose import --lens FILE, or write TOML of all cameras."
        raise InputError(str(path), expected, "another file of OpenCV's FileStorage", todo)
    tables = dict(kalibr_tables(path, read_yaml(path), posed=True))
    return _read_tables(path, tables, Keys(), left_out)


def _read_tables(
    path: Path, tables: Mapping[str, Mapping[str, Any]], keys: Keys, left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return the cameras of tables; those without a pose are left out if others have one."""
    posed = [name for name, table in tables.items() if keys.translation in table]
    if left_out is not None and posed:
        left_out.update({camera_id(name): "it has no pose" for name in tables if name not in posed})
    elif len(posed) < len(tables) or not posed:
        lacking = next((name for name in tables if name not in posed), "no camera")
        todo = "Calibrate the poses too; or import the lenses (worldpose import --lens FILE), "
        todo += "and click the poses."
        raise InputError(f"{path}: {lacking}", "the pose of the camera", "a lens alone", todo)
    cameras = []
    for name in posed:
        where = f"{path}: {name}"
        cameras.append((where, read_camera_table(where, name, tables[name], keys=keys)))
    return index_by_name(path, cameras)


def is_openpose(path: Path) -> bool:
    """Return whether a file is OpenPose's XML of a camera."""
    if path.suffix.lower() != ".xml":
        return False
    try:
        with path.open("rb") as file:
            begin = file.read(4096)
    except OSError:
        return False
    return b"<opencv_storage>" in begin and b"<CameraMatrix" in begin


def read_openpose_cameras(
    files: tuple[Path, ...], sizes: Mapping[str, tuple[int, int]]
) -> dict[str, CameraCalibration]:
    """Return the cameras of OpenPose's files `<camera>.xml`, in the world of the first one [m].

    `CameraMatrix` (3, 4) is [R | t], `Intrinsics` (3, 3), `Distortion` has OpenCV's coefficients.
    `sizes` are width and height [px] of each camera's images, which the files lack.
    """
    cameras = []
    for file in files:
        given, where = read_file_storage(file), str(file)
        size = sizes.get(known_id(file.stem, sizes))
        if size is None:
            expected = f"the image size of camera {file.stem}, which OpenPose's files lack"
            todo = "Import the calibration with --videos, or write it as TOML with a size."
            raise InputError(where, expected, "no video of that name", todo)
        pose = np.asarray(given.get("CameraMatrix"))
        if pose.shape != (3, 4):
            raise calibration_error(f"{where}: CameraMatrix", "shape (3, 4)", f"{pose.shape}")
        table: dict[str, Any] = {
            key: np.asarray(given[key]).tolist()
            for key in ("Intrinsics", "Distortion")
            if key in given
        }
        table |= {"distortion_model": "plumb_bob"}  # the program writes OpenCV's order alone
        table |= {"size": list(size), "R": pose[:, :3].tolist(), "t": pose[:, 3].tolist()}
        keys = Keys("size", "Intrinsics", "Distortion", "R", "t")
        camera = read_camera_table(where, file.stem, table, keys=keys)
        todo = "Give videos of the calibrated size, or write TOML with a size."
        require_middle(where, camera.principal_point_px, size, todo)
        cameras.append((where, camera))
    return index_by_name(files[0].parent, cameras)
