"""Readers and a writer of lenses without a pose: OpenCV FileStorage, npy and npz, TOML.

In the TOML form each table has `size`, `matrix` and `distortions` as in calibration.toml, no
`rotation` and no `translation`, and optionally the deviations `focal_std_px`,
`principal_point_std_px` and `distortion_std`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from data_contracts.arrays import Floats
from data_contracts.cameras import LensCalibration
from worldpose.errors import InputError, describe_value, say_failure
from worldpose.formats.archives import read_npz
from worldpose.formats.calibration_files import (
    MODEL_NAMES,
    calibration_error,
    camera_tables,
    known_id,
    plain_key,
    read_optics,
    tells_model,
)
from worldpose.formats.calibration_unit import require_middle, require_optics, square_focal
from worldpose.formats.calibration_writer import order_entry
from worldpose.formats.files import (
    SETTINGS_BYTES,
    by_last_number,
    read_json,
    read_toml,
    read_yaml,
    require_file,
)
from worldpose.formats.opencv_storage import is_storage, read_file_storage
from worldpose.parsing import read_npy

MATRIX_NAMES: Final = (
    *("cameramatrix", "cammatrix", "mtx", "K", "matrix", "intrinsicmat", "intrinsicmatrix"),
    *("intrinsic", "intrinsics", "k"),
)
DISTORTION_NAMES: Final = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoefs", "distcoeff"),
    *("distcoef", "dist", "cameradist", "distortions", "distortion", "D", "d"),
)
_OWNERS: Final = ("image", "img", "frame", "video", "picture", "calibration", "camera", "cam")
SIZE_NAMES: Final = (
    *((f"{owner}width", f"{owner}height") for owner in ("", *_OWNERS)),
    *(("size",), ("resolution",), ("dim",)),
    *((a + b,) for a, b in product(_OWNERS, ("size", "resolution", "dim"))),
    ("w", "h"),
)


def read_lenses(
    files: Sequence[Path], camera: str | None, sizes: Mapping[str, tuple[int, int]]
) -> dict[str, LensCalibration]:
    """Return lenses by camera.

    Files are one TOML file with a table for each camera; or, for one `camera`, an OpenCV XML, YAML
    or JSON file, TOML without tables, an npz file, or two npy files, one of them the 3 x 3 matrix.
    Kalibr's YAML, and JSON of multical and Panoptic Studio, name their cameras too. A lens of
    another size than `sizes`, width and height [px], and the same shape of image is scaled.
    InputError also if pixels are not square, or the lens folds within the image.
    """
    first = files[0]
    camera = None if camera is None else known_id(camera, sizes)
    if first.suffix.lower() == ".toml":
        content = read_toml(first)
        tables = any(isinstance(each, dict) for each in content.values())
        if tables and not _has_matrix(content):
            return read_lens_toml(first, sizes, camera)
    named = _read_named(first)
    if named is not None:
        if len(named) == 1 and camera is not None:
            named = [(camera, named[0][1])]
        return _lenses(first, [(f"{first}: {n}", n, t) for n, t in named], sizes, camera)
    if camera is None:
        expected = "the camera of this lens"
        todo = f"Name it: --camera {next(iter(sizes), 'NAME')}."
        raise InputError(str(first), expected, "a file without a name for it", todo)
    if camera not in sizes:
        raise _unknown_camera(str(first), camera, sizes)
    given = _read_files(files)
    where = ", ".join(map(str, files))
    usual = "a 3 x 3 camera matrix, named camera_matrix, mtx or K"
    matrix = _pick(where, given, MATRIX_NAMES, usual)
    usual = "distortion coefficients, named distortion_coefficients, dist_coeffs, dist or D"
    distortion = np.ravel(_pick(where, given, DISTORTION_NAMES, usual))
    own, roi = _image_size(given), given.get("roi")
    try:
        matrix, distortion = matrix.astype(np.float64), distortion.astype(np.float64)
        matrix = matrix.reshape(3, 3) if matrix.size == 9 else matrix
        is_whole = own == tuple(sizes[camera])
        if isinstance(roi, Mapping) and "x_offset" in roi and _image_size(roi) and not is_whole:
            own = _image_size(roi)  # of ROS: the images show this part of the sensor
            matrix[:2, 2] -= [roi["x_offset"], roi["y_offset"]]
    except (ValueError, TypeError, LookupError) as error:
        raise calibration_error(where, "matrices of numbers", say_failure(error)) from error
    if "xi" in given:
        raise calibration_error(f"{where}: xi", "a pinhole or fisheye lens", "that of cv2.omnidir")
    table = {
        "size": list(own or sizes[camera]),
        "matrix": matrix.tolist(),
        "distortions": distortion.tolist(),
        **{key: value for key, value in given.items() if tells_model(key)},
    }
    return {camera: _lens(where, camera, table, sizes[camera], has_size=own is not None)}


def read_lens_toml(
    file: Path, sizes: Mapping[str, tuple[int, int]], camera: str | None = None
) -> dict[str, LensCalibration]:
    """Return a TOML file's lenses by camera, or one, without poses; see `read_lenses`."""
    return _lenses(file, camera_tables(file), sizes, camera)


def _lenses(
    file: Path,
    tables: Iterable[tuple[str, str, Mapping[str, Any]]],
    sizes: Mapping[str, tuple[int, int]],
    camera: str | None,
) -> dict[str, LensCalibration]:
    """Return the lenses of tables with their places and names; see `read_lens_toml`."""
    found: dict[str, LensCalibration] = {}
    given = list(tables)
    names = ", ".join(name for _, name, _ in given)
    for where, called, table in given:
        name = known_id(called, sizes)
        if camera is not None and name != camera:
            continue
        if name not in sizes:
            raise _unknown_camera(where, called, sizes)
        if name in found:
            raise calibration_error(where, "a name of its own", f"{name!r} a second time")
        found[name] = _lens(where, name, table, sizes[name])
    if not found:
        todo = f"Rename the camera in the file to {camera}." if names and camera else "Correct it."
        raise InputError(str(file), f"camera {camera or 'NAME'}", names or "none", todo)
    return found


def write_lens_toml(path: Path, lenses: Mapping[str, LensCalibration]) -> None:
    """Write lenses in the form that `read_lens_toml` reads; numbers keep all digits."""
    lines = []
    for name, lens in lenses.items():
        (cx, cy), f = lens.principal_point_px, lens.focal_px
        lines += [
            f'["{name}"]',
            f"size = {list(lens.image_size)}",
            f"matrix = {[[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]]}",
            f"distortions = {list(lens.distortion)}",
            f"focal_std_px = {lens.focal_std_px}",
            f"principal_point_std_px = {lens.principal_point_std_px}",
            f"distortion_std = {lens.distortion_std}",
            *(["fisheye = true"] if lens.lens_model == "fisheye" else []),
            *order_entry(lens),
            "",
        ]
    path.write_text("\n".join(lines), encoding="utf-8")


def _read_files(files: Sequence[Path]) -> dict[str, Any]:
    """Return the entries of the files of one lens; no two of one name may differ."""
    names = {*MATRIX_NAMES, *DISTORTION_NAMES, *chain(*SIZE_NAMES), *MODEL_NAMES}
    given: dict[str, Any] = {}
    for file in files:
        for key, value in _read_file(file).items():
            other = _key(given, names & {plain_key(key)})
            if other is not None and not np.array_equal(given[other], value):
                raise calibration_error(f"{file}: {key}", f"the value of {other}", "another one")
            given[key] = value
    return given


def _read_file(file: Path) -> dict[str, Any]:
    """Return the arrays and numbers of a file by name."""
    suffix = file.suffix.lower()
    require_file(file, SETTINGS_BYTES)
    try:
        if suffix == ".npy":
            with file.open("rb") as stream:
                array = read_npy(stream)
            return {"K" if array.shape == (3, 3) else "dist": array}
    except (OSError, ValueError, EOFError) as error:
        raise calibration_error(str(file), "arrays of numbers", say_failure(error)) from error
    max_bytes = 1 << 26  # of arrays [byte]: calibrations may keep the corners of all boards
    if suffix == ".npz":
        return dict(read_npz(file, max_bytes))
    if suffix in (".yml", ".yaml", ".json", ".toml"):
        return read_file_storage(file) if is_storage(file) else _read_mapping(file)
    if suffix in (".pkl", ".pickle"):
        return read_opencap(file)
    if suffix == ".xml":
        return read_file_storage(file)
    expected = "a lens file: .toml, .xml, .yml, .yaml, .json, .npy, .npz, or OpenCap's .pickle"
    todo = "Save the camera matrix and the distortion coefficients in one of these forms."
    raise InputError(str(file), expected, repr(file.suffix), todo)


def read_opencap(file: Path) -> dict[str, Any]:
    """Return the entries of OpenCap's pickle of one camera, of which nothing is run.

    Its image size has the height first; here the width is first.
    """
    from worldpose.pickles import read_pickle  # late: it imports scipy

    require_file(file, SETTINGS_BYTES)
    try:
        content = read_pickle(file)
    except (OSError, ValueError) as error:
        expected = "OpenCap's pickle of one camera: arrays alone"
        todo = "Give it as OpenCap wrote it. Nothing in this file was run."
        raise InputError(str(file), expected, say_failure(error), todo) from error
    if not isinstance(content, dict):
        raise calibration_error(str(file), "a dictionary", type(content).__name__)
    given = {str(key): value for key, value in content.items()}
    if np.size(given.get("imageSize", ())) == 2:
        given["imageSize"] = np.ravel(given["imageSize"])[::-1]
    if "intrinsicMat" in given:
        given.setdefault("distortion_model", "plumb_bob")  # the program writes OpenCV's order alone
    return given


def _read_named(file: Path) -> list[tuple[str, dict[str, Any]]] | None:
    """Return names and tables of a file with several cameras; None for another file.

    It is a camchain of Kalibr, or JSON of multical or Panoptic Studio: `cameras` have the matrices.
    """
    if file.suffix.lower() not in (".yml", ".yaml", ".json") or is_storage(file):
        return None
    content = read_json(file) if file.suffix.lower() == ".json" else read_yaml(file)
    if is_kalibr(content):
        return list(kalibr_tables(file, content, posed=False))
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if isinstance(cameras, list):
        cameras = [(each.get("name") if isinstance(each, dict) else None, each) for each in cameras]
    else:
        cameras = list(cameras.items()) if isinstance(cameras, dict) else []
    if _has_matrix(content) or not any(_has_matrix(one) for _, one in cameras):
        return None
    ours = {"K": "matrix", "dist": "distortions", "distCoef": "distortions"}
    ours |= {"image_size": "size", "resolution": "size"}
    found = []
    for index, (name, table) in enumerate(cameras):
        if name in (None, "") or not isinstance(table, dict):
            where = f"{file}: cameras[{index}]"
            raise calibration_error(where, "a lens with a name", describe_value(table))
        lens = {ours.get(str(key), str(key)): value for key, value in table.items()}
        found.append((str(name), lens))
    return found


def is_kalibr(content: object) -> bool:
    """Return whether the content of a YAML file is a camchain."""
    tables = list(content.values()) if isinstance(content, dict) else []
    cameras = [each for each in tables if isinstance(each, dict) and "camera_model" in each]
    return any("intrinsics" in each for each in cameras)


def kalibr_tables(
    path: Path, content: object, *, posed: bool
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of each camera of a camchain, and its table in Anipose's form, perhaps posed.

    InputError for another model than the pinhole with `radtan`, `equidistant` or no distortion.
    """
    if not isinstance(content, dict) or not is_kalibr(content):
        expected = "a camchain of Kalibr, or EasyMocap's intri.yml and extri.yml"
        raise calibration_error(str(path), expected, f"{content!r:.60}")
    pose: NDArray[np.float64] | None = np.eye(4)
    tables = {str(name): given for name, given in content.items() if isinstance(given, dict)}
    if all(re.fullmatch(r"cam\d+", name) for name in tables):
        tables = by_last_number(tables)  # Kalibr writes cam0, cam1, cam10, cam2
    for index, (name, given) in enumerate(tables.items()):
        where = f"{path}: {name}"
        model, lens = given.get("camera_model"), given.get("distortion_model", "none")
        if model != "pinhole" or lens not in ("radtan", "equidistant", "none"):
            expected = "camera_model pinhole with distortion_model radtan, equidistant or none"
            todo = "Calibrate again with --models pinhole-radtan or pinhole-equi."
            raise InputError(where, expected, f"{model} with {lens}", todo)
        numbers = given.get("intrinsics")
        if not isinstance(numbers, list) or len(numbers) != 4:
            raise calibration_error(f"{where}.intrinsics", "fx, fy, cx, cy", f"{numbers!r:.60}")
        fx, fy, cx, cy = numbers
        table: dict[str, Any] = {
            "size": given.get("resolution", []),
            "matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
            "distortions": given.get("distortion_coeffs") or [0.0] * 4,
            "distortion_model": lens,
        }
        if not posed:
            yield name, table
            continue
        if not index and "T_cn_cnm1" in given:
            expected = "none in the first camera, from which the others are counted"
            raise calibration_error(f"{where}.T_cn_cnm1", expected, "a pose of it")
        if index:
            pose = _chain(f"{where}.T_cn_cnm1", given.get("T_cn_cnm1"), pose)
        if pose is not None:
            table |= {"rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist()}
        yield name, table


def _chain(
    where: str, step: object, pose: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """Return the pose (4, 4) of a camera from that of the camera before; None if not known."""
    if step is None or pose is None:
        return None
    try:
        matrix = np.array(step, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (16,)):
        raise calibration_error(where, "numbers of shape (4, 4)", f"{step!r:.60}")
    return matrix.reshape(4, 4) @ pose


def _read_mapping(file: Path) -> dict[str, Any]:
    """Return plain JSON, YAML or TOML; matrices are rows, or ROS's `rows`, `cols` and `data`."""
    suffix = file.suffix.lower()
    content: Any = read_toml(file) if suffix == ".toml" else None
    if content is None:
        content = read_json(file) if suffix == ".json" else read_yaml(file)
    if not isinstance(content, dict):
        raise calibration_error(str(file), "a mapping", type(content).__name__)
    found: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict) and {"rows", "cols", "data"} <= value.keys():
            try:
                found[str(name)] = np.reshape(value["data"], (value["rows"], value["cols"]))
            except (ValueError, TypeError, OverflowError) as error:
                parts = [f"{key} {describe_value(value[key])}" for key in ("rows", "cols", "data")]
                expected = "data of rows x cols numbers"
                raise calibration_error(f"{file}: {name}", expected, ", ".join(parts)) from error
        elif isinstance(value, list | int | float | str) or plain_key(str(name)) in {
            *("roi", *chain(*SIZE_NAMES))
        }:
            found[str(name)] = value
    return found


def _has_matrix(given: object) -> bool:
    """Return whether a mapping has a camera matrix itself, not in a table of that name."""
    own = given.items() if isinstance(given, dict) else ()
    plain = {str(key): each for key, each in own if not isinstance(each, dict) or "data" in each}
    return _key(plain, MATRIX_NAMES) is not None


def _key(given: Mapping[str, Any], names: Iterable[str]) -> str | None:
    """Return the key with the first of these names that there is, in any spelling."""
    plain = {plain_key(key): key for key in given}
    return next((plain[name] for name in names if name in plain), None)


def _pick(where: str, given: Mapping[str, Any], names: Sequence[str], what: str) -> NDArray[Any]:
    """Return the entry with one of the usual names."""
    key = _key(given, names)
    if key is not None:
        return np.asarray(given[key])
    todo = "Add it to the file, or give the file that has it: --lens may come twice."
    expected = f"{what} (capitals and underscores of words do not matter)"
    raise InputError(where, expected, ", ".join(sorted(given)) or "nothing", todo)


def _image_size(given: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the image size in a file, as two numbers, `width` and `height`, or "1920x1080"."""
    number = r"(\d+\.?\d*(?:e[-+]?\d+)?)"
    for names in SIZE_NAMES:
        value = [given[key] for key in (_key(given, [name]) for name in names) if key]
        if len(value) == 1 and isinstance(value[0], Mapping):
            value = list(_image_size(value[0]) or ())
        flat = [str(one) for each in value for one in np.ravel(np.asarray(each, object))]
        text = " ".join(flat).lower()
        found = re.search(r"(\d+) *x *(\d+)", text)
        found = found or re.fullmatch(rf"\W*{number}[\s,]+{number}\W*", text)
        if found and min(sides := [int(float(each)) for each in found.groups()]) >= 32:
            return sides[0], sides[1]
    return None


def _lens(
    where: str, name: str, table: Mapping[str, Any], size: tuple[int, int], *, has_size: bool = True
) -> LensCalibration:
    """Return the lens of a table at the size of the camera's images."""
    # The same of the image corner's displacement, relative to its distance from the centre
    # [1]: boards seldom reach the corners.
    distortion_std = 0.005
    principal_point_std = 0.005  # the same of the principal point, in image widths [1]
    # Relative deviation of a focal length whose file states none [1]: board calibrations with
    # a dozen images repeat within 1 %.
    focal_std = 0.01
    optics = read_optics(where, table)
    require_optics(where, optics.size, optics.focal, optics.principal_point)
    scale = _scale(where, optics.size, size)
    focal = square_focal(optics.focal.tolist(), where)[0] * scale
    # Pixel centres are whole numbers, so that the image's corner is at -0.5.
    middle = (optics.principal_point + 0.5) * scale - 0.5
    deviations = {
        "focal_std_px": _deviation(where, table, "focal_std_px", scale, focal_std * focal),
        "principal_point_std_px": _deviation(
            where, table, "principal_point_std_px", scale, principal_point_std * size[0]
        ),
        "distortion_std": _deviation(where, table, "distortion_std", 1.0, distortion_std),
    }
    try:
        lens = LensCalibration(
            id=name,
            image_size=size,
            focal_px=focal,
            principal_point_px=(float(middle[0]), float(middle[1])),
            distortion=tuple(optics.distortion.tolist()),
            lens_model=optics.lens_model,
            **deviations,
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        entry = ".".join(map(str, first["loc"]))
        raise calibration_error(
            f"{where}.{entry}", str(first["msg"]), str(first["input"])
        ) from error
    if not has_size:
        todo = "Add the calibrated images' size to the file: image_size = [WIDTH, HEIGHT]."
        require_middle(where, lens.principal_point_px, size, todo)
    from worldpose.geometry.cameras import Camera  # late: it loads the kernels

    Camera.from_lens(lens).require_rays(where)
    return lens


def _deviation(
    where: str, table: Mapping[str, Any], key: str, scale: float, otherwise: float
) -> float:
    value = table.get(key)
    if value is None:
        return otherwise
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise calibration_error(f"{where}.{key}", "a number", repr(value))
    return float(value) * scale


def _scale(where: str, size: Floats, own: tuple[int, int]) -> float:
    """Return pixels of the camera's image per pixel of the calibrated one."""
    scale = np.array(own) / size
    if abs(scale[0] - scale[1]) > 0.002 * scale[0]:
        expected = f"{own[0]} x {own[1]} px, the camera's images, or the same shape"
        todo = "Give a lens that was calibrated in images of the video's shape: a crop has another "
        todo += "principal point."
        raise InputError(f"{where}: size", expected, f"{size[0]:g} x {size[1]:g}", todo)
    return float(scale[0])


def _unknown_camera(where: str, name: str, sizes: Mapping[str, object]) -> InputError:
    todo = "Rename the cameras in the file as in match.yaml; --camera NAME then reads one alone, "
    todo += "and the others may have any name."
    return InputError(where, f"a static camera of match.yaml: {', '.join(sizes)}", repr(name), todo)
