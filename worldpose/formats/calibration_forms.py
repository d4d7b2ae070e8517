"""Calibrations of all forms: which form a file or folder has, and those of one file per camera.

`FORMS` lists the forms. OpenCap and bioCV have a file per camera, EasyMocap has one file of lenses
and one of poses; a folder then stands for all of them.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import CameraCalibration
from worldpose.errors import InputError, say_failure
from worldpose.formats.calibration_files import (
    Keys,
    LeftOut,
    calibration_error,
    camera_id,
    index_by_name,
    known_id,
    read_calibration_toml,
    read_camera_table,
)
from worldpose.formats.calibration_programs import (
    is_openpose,
    json_unit_m,
    read_camera_json,
    read_kalibr,
    read_openpose_cameras,
)
from worldpose.formats.calibration_systems import read_calibration_xml
from worldpose.formats.calibration_unit import (
    MILLIMETRE,
    doubt_middle,
    require_metres,
    require_middle,
    toml_unit_m,
)
from worldpose.formats.files import SETTINGS_BYTES, require_file
from worldpose.formats.lens_files import read_opencap
from worldpose.formats.opencv_storage import read_file_storage
from worldpose.video.names import is_video

if TYPE_CHECKING:
    from worldpose.geometry.cameras import Camera

OPENCAP_NAME: Final = "cameraIntrinsicsExtrinsics"
"""Stem of OpenCap's files; the folder of each is called as the camera."""

OPENCAP_KEYS: Final = Keys("imageSize", "intrinsicMat", "distortion", "rotation", "translation")


Sizes: TypeAlias = Mapping[str, tuple[int, int]]
"""Width and height [px] by camera."""


class Form(NamedTuple):
    """A form of calibrations."""

    name: str
    """Programs that write it."""
    endings: tuple[str, ...]
    """How the names of its files end; the first one tells the form without doubt."""
    unit: str
    """Unit of positions, and the axis that points up."""
    read: Callable[[tuple[Path, ...], Sizes, LeftOut | None], dict[str, CameraCalibration]]
    """Reads its files, with image sizes that they may lack, and receives cameras without a pose."""


def read_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Return the cameras of a calibration by name, in file order.

    Args:
        path: file or folder as in `read_calibration`.

    Raises:
        InputError: an unknown form, or an invalid entry, with file and key.
    """
    from worldpose.geometry.cameras import Camera  # late: most commands only check calibrations

    left_out = LeftOut()
    given = read_calibration(Path(path), left_out=left_out)
    for name, why in left_out.items():
        warnings.warn(f"{path}: camera {name} is left out: {why}", stacklevel=2)
    return {name: Camera.from_calibration(calibration) for name, calibration in given.items()}


def read_calibration(
    path: Path,
    sizes: Sizes = MappingProxyType({}),
    left_out: LeftOut | None = None,
    *,
    any_unit: bool = False,
) -> dict[str, CameraCalibration]:
    """Return the cameras of a file of one of `FORMS`, or of a folder that has one, in file order.

    `sizes` are image sizes that the file may lack, such as those of the videos; `left_out` receives
    cameras without a pose, with the reason; None = all must have one. With `any_unit`, cameras may
    be as far apart as in another unit than the form's.
    """
    form, files = find_calibration(path) if path.is_dir() else _form_of(path)
    cameras = form.read(files, sizes, left_out)
    poses = {name: np.c_[one.rotation, one.translation] for name, one in cameras.items()}
    # No two cameras are at one place with one rotation; a single one may be at the origin.
    lost = [
        n for n, one in poses.items() if sum(np.array_equal(one, p) for p in poses.values()) > 1
    ]
    if lost:
        names = ", ".join(lost)
        if left_out is None or len(lost) == len(cameras):
            raise calibration_error(f"{path}: {names}", "poses", "the same place and rotation")
        left_out.update(dict.fromkeys(lost, f"it has no pose of its own, but one for {names}"))
        cameras = {name: camera for name, camera in cameras.items() if name not in lost}
    if not any_unit:
        require_metres(path, cameras, form_unit_m(path))
    if left_out is not None:
        for name, camera in cameras.items():
            left_out.notes += doubt_middle(name, camera.principal_point_px, camera.image_size)
    return cameras


def is_of_sensor(path: Path) -> bool:
    """Return whether a calibration is of sensors, of which videos may show the middle alone."""
    form, _ = find_calibration(path) if path.is_dir() else _form_of(path)
    return form is VICON


def form_unit_m(path: Path) -> float:
    """Return the unit of a calibration by its form [m]; arguments and errors as above."""
    form, files = find_calibration(path) if path.is_dir() else _form_of(path)
    if form is TOML:
        return toml_unit_m(files[0])
    if form is JSON:
        return json_unit_m(files[0])
    return MILLIMETRE if form.unit.startswith("mm") else 1.0


def find_calibration(folder: Path) -> tuple[Form, tuple[Path, ...]]:
    """Return form and files of the one calibration in a folder; InputError if there is not one."""
    found = calibrations_in(folder)
    if len(found) == 1:
        return found[0]
    others = ", ".join(sorted(each.name for each in folder.iterdir()))
    listed = "; ".join(
        f"{files[0].name}{f' and {len(files) - 1} more' if len(files) > 1 else ''} ({form.name})"
        for form, files in found
    )
    raise InputError(
        str(folder),
        expected="one calibration: " + _list_forms(),
        found=listed or f"none{others and f'; there are {others:.100}'}",
        todo="Give the file that is meant, or move the others elsewhere."
        if found
        else "Export the calibration in one of these forms.",
    )


def calibrations_in(folder: Path) -> list[tuple[Form, tuple[Path, ...]]]:
    """Return the form and the files of every calibration in a folder, TOML files first.

    OpenCap's files may be in folders named after the cameras, as in its sessions.
    """
    files = [
        file
        for file in sorted(folder.iterdir())
        if file.is_file() and not file.name.startswith(".") and file.name != "Config.toml"
    ]
    nested = sorted(folder.glob(f"*/{OPENCAP_NAME}.pickle"))
    sets: dict[str, tuple[Path, ...]] = {
        OPENCAP.name: tuple(f for f in files if f.suffix.lower() in OPENCAP.endings)
        or tuple(nested),
        EASYMOCAP.name: tuple(f for f in files if _is_easymocap(f)),
        BIOCV.name: tuple(f for f in files if f.suffix.lower() in BIOCV.endings),
        OPENPOSE.name: tuple(f for f in files if is_openpose(f)),
    }
    found: list[tuple[Form, tuple[Path, ...]]] = [
        (form, (file,))
        for form in (TOML, QUALISYS, VICON, OPTITRACK)
        for file in files
        if file.name.lower().endswith(form.endings[0])
    ]
    found += [
        (form, (file,))
        for form, name in ((JSON, "calib"), (KALIBR, "camchain"))
        for file in files
        if file.suffix.lower() in form.endings and name in file.stem.lower()
    ]
    return found + [(form, sets[form.name]) for form in FORMS if sets.get(form.name)]


def _list_forms() -> str:
    return ", ".join(f"{' and '.join(form.endings[:2])} ({form.name})" for form in FORMS).replace(
        ".qca.txt and .txt", ".qca.txt"
    )


def _is_easymocap(file: Path) -> bool:
    return file.suffix.lower() in (".yml", ".yaml") and file.stem.lower().startswith(
        ("intri", "extri")
    )


def _form_of(path: Path) -> tuple[Form, tuple[Path, ...]]:
    """Return the form and the files of a calibration, from the name of one of its files."""
    require_file(path)
    suffix = path.suffix.lower()
    if _is_easymocap(path):
        return EASYMOCAP, tuple(f for f in sorted(path.parent.iterdir()) if _is_easymocap(f))
    if is_openpose(path):
        return OPENPOSE, tuple(f for f in sorted(path.parent.iterdir()) if is_openpose(f))
    for form in FORMS:
        if suffix in form.endings:
            return form, (path,)
    todo = "Export the calibration in one of these forms."
    if suffix == ".cal":
        todo = "Open it in Motive 3.2 or later, and export it as .mcal."
    expected = "a calibration: " + _list_forms()
    raise InputError(str(path), expected, f"a file that ends in {path.suffix!r}", todo)


def _read_opencap(files: tuple[Path, ...]) -> dict[str, CameraCalibration]:
    """Return the cameras of OpenCap's pickles, of which nothing is run.

    Each has `intrinsicMat` (3, 3), `distortion` (k1 k2 p1 p2 k3), `imageSize` (height, width),
    `rotation` and `translation` [mm] of x_cam = R x_board + t. The board stands, on its head or
    not, or lies on the ground: the camera images are upright, so that the board's axis along which
    they point down tells which. The world is the board's, turned so that z is up; of a standing
    board as in Pose2Sim's conversion: x' = -x, y' = -z, z' = -y.
    """
    upright = 0.75  # mean cosine of images' down and the vertical: 40 degrees [1]
    tables = {file: _read_pickle(file) for file in files}
    down = np.mean([_downward(file, table) for file, table in tables.items()], axis=0)
    # (3, 3) from a board whose y points down to a world with z up.
    from_standing = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    # (3, 3) from a board whose y points up.
    from_turned = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    # (3, 3) from a board on the ground, whose z points into it.
    from_lying = np.diag([1.0, -1.0, -1.0])
    cosine, axes = max(
        ((down[1], from_standing), (-down[1], from_turned), (down[2], from_lying)),
        key=lambda place: float(place[0]),
    )
    if not cosine >= upright:
        raise InputError(
            f"{files[0]}: rotation",
            expected="cameras that are level within 40 degrees, and a board that stands or lies",
            found=f"a mean downward axis of {np.round(down, 2).tolist()} in the board's axes",
            todo="Give the files of one session, all of them, as OpenCap wrote them.",
        )
    return index_by_name(
        files[0].parent,
        [
            (
                str(file),
                read_camera_table(
                    str(file),
                    file.resolve().parent.name if file.stem == OPENCAP_NAME else file.stem,
                    table,
                    keys=OPENCAP_KEYS,
                    unit_m=MILLIMETRE,
                    axes=axes,
                ),
            )
            for file, table in tables.items()
        ],
    )


def _read_pickle(file: Path) -> dict[str, Any]:
    """Return the entries of an OpenCap pickle with a pose, as numbers and lists."""
    content = read_opencap(file)
    if "intrinsicMat" in content and "rotation" not in content:
        todo = "Give cameraIntrinsicsExtrinsics.pickle, not cameraIntrinsics.pickle."
        raise InputError(f"{file}: rotation", "the pose of the camera", "a lens alone", todo)
    return {
        key: np.squeeze(value).tolist() if isinstance(value, np.ndarray) else value
        for key, value in content.items()
    }


def _downward(file: Path, table: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return the axis (3,) of the board along which a camera's images point down."""
    try:
        rotation = np.array(table.get("rotation"), np.float64)
    except (TypeError, ValueError):
        rotation = np.zeros(0)
    if rotation.shape != (3, 3):
        raise calibration_error(f"{file}.rotation", "numbers of shape (3, 3)", "something else")
    return np.asarray(rotation[1], np.float64)


def _read_easymocap(
    files: tuple[Path, ...], sizes: Sizes, left_out: LeftOut | None
) -> dict[str, CameraCalibration]:
    """Return the cameras of EasyMocap's intri.yml and extri.yml, files of OpenCV's FileStorage.

    For each of `names`: K, dist (k1 k2 p1 p2 k3), H and W [px] in intri.yml, and R (Rodrigues
    vector) or Rot (3, 3) and T [m] of x_cam = R x_world + t in extri.yml.
    """
    by_kind = {
        kind: [file for file in files if file.stem.lower().startswith(kind)]
        for kind in ("intri", "extri")
    }
    if any(len(some) != 1 for some in by_kind.values()):
        expected = "one intri.yml of lenses and one extri.yml of poses"
        todo = "Put both into one folder, without others."
        raise InputError(
            str(files[0].parent), expected, ", ".join(file.name for file in files), todo
        )
    ((lens_file,), (pose_file,)) = by_kind["intri"], by_kind["extri"]
    lenses, poses = read_file_storage(lens_file), read_file_storage(pose_file)
    names = lenses.get("names")
    if not isinstance(names, list) or not names:
        raise calibration_error(f"{lens_file}: names", "a list of cameras", "none")
    posed = [name for name in names if f"T_{name}" in poses]
    if left_out is not None and posed:
        left_out.update({camera_id(name): "it has no pose" for name in names if name not in posed})
        lost = [key[2:] for key in poses if key[:2] == "T_" and key[2:] not in names]
        left_out.update({camera_id(name): f"{lens_file.name} has no lens of it" for name in lost})
        names = posed
    cameras = []
    for name in names:
        where = f"{lens_file}: {name}"
        todo = (
            f"Add the width and height of the calibrated images: a line W_{name}: 1920 and a line "
            f"H_{name}: 1080."
        )
        known = None if f"W_{name}" in lenses else sizes.get(known_id(name, sizes))
        if known is not None:
            lenses |= {f"W_{name}": float(known[0]), f"H_{name}": float(known[1])}
        if f"W_{name}" not in lenses or f"H_{name}" not in lenses:
            expected = f"the image size of camera {name}"
            raise InputError(f"{lens_file}: W_{name}", expected, "none", todo)
        entries = {
            "W, H": [lenses[f"W_{name}"], lenses[f"H_{name}"]],
            f"K_{name}": lenses.get(f"K_{name}"),
            f"dist_{name}": lenses.get(f"dist_{name}", lenses.get(f"D_{name}")),
            f"R_{name}": poses.get(f"R_{name}", poses.get(f"Rot_{name}")),
            f"T_{name}": poses.get(f"T_{name}"),
            "distortion_model": "plumb_bob",  # the program writes OpenCV's order alone
        }
        for key, value in entries.items():
            if value is None:
                file = lens_file if key[0] in "Kd" else pose_file
                raise calibration_error(f"{file}: {key}", "a matrix", "nothing")
        table = {
            key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in entries.items()
        }
        keys = Keys("W, H", f"K_{name}", f"dist_{name}", f"R_{name}", f"T_{name}")
        camera = read_camera_table(where, name, table, keys=keys, where_pose=f"{pose_file}: {name}")
        if known is not None:
            require_middle(where, camera.principal_point_px, known, todo)
        cameras.append((where, camera))
    return index_by_name(lens_file, cameras)


def _read_biocv(files: tuple[Path, ...]) -> dict[str, CameraCalibration]:
    """Return the cameras of bioCV's text files, each of 32 numbers.

    Width, height [px], K (3, 3), L (4, 4) of x_cam = L x_world [mm], and k1 k2 p1 p2 k3. The name
    of `01.mp4.calib` is 01. Format: class Calibration of camera-mc-dev/mc_core.
    """
    cameras = []
    for file in files:
        where = str(file)
        require_file(file, SETTINGS_BYTES)
        try:
            numbers = [float(word) for word in file.read_text(encoding="utf-8").split()]
        except (OSError, ValueError) as error:
            raise calibration_error(where, "32 numbers", say_failure(error)[:80]) from error
        if len(numbers) != 32:
            raise calibration_error(
                where, "32 numbers: width, height, K, L and five of the lens", str(len(numbers))
            )
        pose = np.array(numbers[11:27]).reshape(4, 4)
        if not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
            raise calibration_error(f"{where}: L", "a last row 0 0 0 1", str(pose[3].tolist()))
        table = {
            "size": numbers[:2],
            "K": np.array(numbers[2:11]).reshape(3, 3).tolist(),
            "distortion": numbers[27:],
            "distortion_model": "plumb_bob",
            "rotation of L": pose[:3, :3].tolist(),
            "translation of L": pose[:3, 3].tolist(),
        }
        keys = Keys("size", "K", "distortion", "rotation of L", "translation of L")
        name = Path(file.stem).stem if is_video(file.stem) else file.stem
        camera = read_camera_table(where, name, table, keys=keys, unit_m=MILLIMETRE)
        cameras.append((where, camera))
    return index_by_name(files[0].parent if len(files) > 1 else files[0], cameras)


TOML: Final = Form(
    "Anipose, Pose2Sim, caliscope, FreeMoCap",
    (".toml",),
    "m (FreeMoCap: mm), z up",
    lambda files, sizes, left_out: read_calibration_toml(files[0], left_out, sizes),
)
QUALISYS: Final = Form(
    "Qualisys",
    (".qca.txt", ".txt", ".xml"),
    "mm, z up",
    lambda files, _, left_out: read_calibration_xml(files[0], left_out),
)
VICON: Final = Form("Vicon", (".xcp",), "mm, z up", QUALISYS.read)
OPTITRACK: Final = Form("OptiTrack", (".mcal",), "m, y up", QUALISYS.read)
OPENCAP: Final = Form(
    "OpenCap", (".pickle",), "mm, those of the board", lambda files, *_: _read_opencap(files)
)
EASYMOCAP: Final = Form("EasyMocap", ("intri.yml", "extri.yml"), "m, z up", _read_easymocap)
BIOCV: Final = Form("bioCV", (".calib",), "mm, z up", lambda files, *_: _read_biocv(files))
JSON: Final = Form(
    "Panoptic Studio, multical, K R t",
    (".json",),
    "cm, y down; multical: m, first camera; K R t: m, z up",
    lambda files, _, left_out: read_camera_json(files[0], left_out),
)
KALIBR: Final = Form(
    "Kalibr",
    (".yaml", ".yml"),
    "m, first camera",
    lambda files, _, left_out: read_kalibr(files[0], left_out),
)
OPENPOSE: Final = Form(
    "OpenPose",
    ("<camera>.xml",),
    "m, first camera",
    lambda files, sizes, _: read_openpose_cameras(files, sizes),
)
FORMS: Final = (
    *(TOML, QUALISYS, VICON, OPTITRACK, OPENCAP, EASYMOCAP, BIOCV),
    *(JSON, KALIBR, OPENPOSE),
)
"""All forms; docs/reference/formats.md describes them."""
