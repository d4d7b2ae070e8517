"""Body models as files: the open body, and the installation of a user's own such as SMPL.

SMPL's licence forbids to ship it. Installed models are npz files with arrays under SMPL's own keys
and a name, never pickles.
"""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import OTHER_UNITS
from worldpose.body.model import POSE_FEATURES, SMPL_VERTICES, BodyModel
from worldpose.errors import InputError, UsageError
from worldpose.parsing import read_npz_members

OPEN_BODY: Final = "open-neutral/2"
"""The body that ships with worldpose: SMPL's layout, not SMPL (docs/reference/body_model.md)."""
NARROW_OPEN_BODY: Final = "open-neutral/3"
"""The open body with hip joints as far apart as people's; its surface is the same."""

KEYS: Final = (
    *("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f"),
)
"""Names of a model's arrays in SMPL's files."""

BODY_FOLDER: Final = Path("~/.local/share/worldpose/bodies")
"""Folder of installed bodies, unless the environment names another one."""
BODY_FOLDER_VARIABLE: Final = "WORLDPOSE_BODY_FOLDER"
"""Environment variable with the folder of installed bodies."""

_NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]*")


@lru_cache(maxsize=2)
def load_open_body(name: str = OPEN_BODY) -> BodyModel:
    """Return the open body: 6890 vertices, 24 joints, 10 betas, free for any use (CC0).

    Both versions have the same surface; the later one has narrower hip joints.
    """
    wide = load_body(Path(__file__).parent / "open_body.npz")
    return _move_hips(wide) if name == NARROW_OPEN_BODY else wide


def _move_hips(wide: BodyModel) -> BodyModel:
    """Return the open body with the hip joints moved towards each other, for every shape alike."""
    left, right = wide.joint_template[1:3]
    # Distance between the hip joints of the mean narrow body [m], 0.230 in the other.
    share = 0.5 * (1.0 - 0.175 / float(np.linalg.norm(left - right)))
    regressor = wide.joint_regressor.copy()
    moved = (1.0 - share) * regressor[1:3] + share * regressor[2:0:-1]
    regressor[1:3] = moved.astype(np.float32)  # as in a body's file
    return replace(wide, name=NARROW_OPEN_BODY, joint_regressor=regressor)


def is_open_body(name: str) -> bool:
    """Return whether a body model is a version of the open body."""
    return name in (OPEN_BODY, NARROW_OPEN_BODY)


def load_body(path: Path) -> BodyModel:
    """Return the body model of a file that `save_body` wrote; InputError if it is none."""
    arrays = read_npz_arrays(path, (*KEYS, "name"))
    return _build_model(arrays, str(arrays["name"]), path)


def save_body(path: Path, model: BodyModel) -> None:
    """Write a model in single precision, 0.1 um, whole or not at all; InputError if it differs."""
    root = np.where(model.parents < 0, np.iinfo(np.uint32).max, model.parents)
    arrays = {
        "v_template": model.template.astype(np.float32),
        "shapedirs": model.shape_directions.astype(np.float32),
        "posedirs": model.pose_directions.astype(np.float32),
        "J_regressor": model.joint_regressor.astype(np.float32),
        "weights": model.weights.astype(np.float32),
        "kintree_table": np.stack([root, np.arange(len(root))]),
        "f": model.faces.astype(np.uint32),
    }
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, name=np.array(model.name), **arrays)
        if path.is_file() and path.read_bytes() != partial.read_bytes():
            raise InputError(
                str(path),
                expected="no other body model of this name: results of runs belong to it",
                found="one",
                todo="Give another name with --name, or remove this file first.",
            )
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_npz_arrays(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Return arrays of an npz file with these keys; Python objects in it are refused unread."""
    try:
        arrays = read_npz_members(path, keys)
        return {key: arrays[key] for key in keys}
    except KeyError as error:
        raise _body_file_error(path, f"no array named {error.args[0]}") from None
    except (OSError, EOFError, ValueError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise _body_file_error(path, f"a file that cannot be read ({error})") from None


def read_pickled_arrays(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Return arrays of a pickled dictionary, dense even if the pickle holds sparse ones.

    The function reads numpy's, scipy's and chumpy's arrays without running anything that the file
    names (`worldpose.pickles`). InputError if the file names anything but arrays, or lacks a key.
    """
    from worldpose.pickles import read_pickle  # late: it imports scipy

    try:
        content = read_pickle(path)
    except (OSError, MemoryError) as error:
        raise _body_file_error(path, f"a file that cannot be read ({error})") from None
    except ValueError as error:
        raise _body_file_error(path, f"a file that cannot be read as a pickle ({error})") from error
    if not isinstance(content, dict):
        raise _body_file_error(path, f"a pickled {type(content).__name__.lower()}")
    lacking = [key for key in keys if key not in content]
    if lacking:
        raise _body_file_error(path, f"no array named {', '.join(lacking)}")
    for key in keys:
        array = content[key]
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise _body_file_error(path, f"{key} that is not an array of numbers")
    return {key: content[key] for key in keys}


def _body_file_error(path: Path, found: str) -> InputError:
    """Return the error of a file that is not a body model."""
    return InputError(
        str(path),
        expected=f"a body model with the arrays {', '.join(KEYS)}",
        found=found,
        todo="Give SMPL's own .pkl or .npz to worldpose body install.",
    )


def _build_model(arrays: Mapping[str, NDArray[np.generic]], name: str, path: Path) -> BodyModel:
    """Return the model of a file's arrays; InputError if they are not a body model's."""
    for key, array in arrays.items():
        dimensions = 3 if key in ("shapedirs", "posedirs") else 2
        kinds = "iu" if key in ("kintree_table", "f") else "fiu"
        if key in KEYS and (array.ndim != dimensions or array.dtype.kind not in kinds):
            raise _body_file_error(path, f"{key} of shape {array.shape} and type {array.dtype}")
    parents = arrays["kintree_table"][:1].astype(np.int64).ravel()
    try:
        return BodyModel(
            name=name,
            template=arrays["v_template"].astype(np.float64),
            # Number of betas that are read, as in the released poses.
            shape_directions=arrays["shapedirs"][:, :, :10].astype(np.float64),
            pose_directions=arrays["posedirs"].astype(np.float64),
            joint_regressor=arrays["J_regressor"].astype(np.float64),
            weights=arrays["weights"].astype(np.float64),
            # The pelvis has -1 written as an unsigned number.
            parents=np.where(parents == np.iinfo(np.uint32).max, -1, parents),
            faces=arrays["f"].astype(np.int64),
        )
    except InputError as error:
        raise InputError(
            f"{path}: {error.where}", expected=error.expected, found=error.found, todo=error.todo
        ) from None


def body_folder() -> Path:
    """Return the folder of installed bodies: WORLDPOSE_BODY_FOLDER, or else the user's."""
    return Path(given_body_folder() or BODY_FOLDER).expanduser().absolute()


def given_body_folder() -> str | None:
    """Return the folder that WORLDPOSE_BODY_FOLDER names, absolute; None if it is not set."""
    given = os.environ.get(BODY_FOLDER_VARIABLE)
    return str(Path(given).expanduser().absolute()) if given else None


def install_body(file: Path, folder: Path | None = None, name: str | None = None) -> BodyModel:
    """Return a model read from SMPL's own file, .pkl or .npz, after saving it as a safe npz file.

    `<name>.npz` is written to `folder`, `body_folder()` by default. InputError if the file is no
    body model in SMPL's layout, names code to run, or another one of the name is installed;
    UsageError if the name is invalid.
    """
    model_name = name or file.stem.lower().replace("_", "-")
    if not _NAME.fullmatch(model_name) or model_name.startswith("open-neutral"):
        raise UsageError(
            f"name of the body model {model_name!r}",
            expected="small letters, digits, dots and hyphens, and not that of the open body",
            found=repr(model_name),
            todo="Give another name with --name.",
        )
    reader = read_npz_arrays if zipfile.is_zipfile(file) else read_pickled_arrays
    model = _build_model(reader(file, KEYS), model_name, file)
    counts = len(model.template), model.pose_directions.shape[-1], model.shapes > 0
    if counts != (SMPL_VERTICES, POSE_FEATURES, True):
        raise InputError(
            str(file),
            expected=f"{SMPL_VERTICES} vertices, {POSE_FEATURES} pose and some shape directions",
            found=f"{counts[0]}, {counts[1]} and {model.shapes}",
            todo="Take SMPL's file, not that of SMPL-H, SMPL-X or another model.",
        )
    _require_metres(file, float(np.ptp(model.template, axis=0).max()))
    _require_axes(file, model)
    path = body_path(model_name, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_body(path, model)
    return load_body(path)


def _require_metres(file: Path, span: float) -> None:
    """Raise InputError if a body's template, whose largest span is given, is not in metres."""
    least, most = 0.4, 2.6  # an infant, and an adult with spread arms
    if least <= span <= most:
        return
    fits = [name for name, metres in OTHER_UNITS.items() if 1.4 <= span * metres <= most]
    raise InputError(
        f"{file}: v_template",
        expected=f"a body in metres, {least:g} to {most:g} in its largest span",
        found=f"{span:.4g}, as of {fits[0]}" if fits else f"{span:.4g}",
        todo="Give SMPL's file as downloaded, or bring v_template, shapedirs and posedirs to "
        "metres.",
    )


def _require_axes(file: Path, model: BodyModel) -> None:
    """Raise InputError if the left is not at x, up at y and ahead at z, or shapes are no metres."""
    joints = model.joint_regressor @ model.template
    left, up = joints[1] - joints[2], joints[15] - joints[0]  # hips; head and pelvis
    ahead = joints[10:12].sum(axis=0) - joints[7:9].sum(axis=0)  # feet and ankles
    largest = [int(np.abs(way).argmax()) for way in (left, up, ahead)]
    signs = [way[n] < 0.0 for way, n in zip((left, up, ahead), largest, strict=True)]
    shown = ", ".join("+-"[int(s)] + "xyz"[n] for s, n in zip(signs, largest, strict=True))
    reach = float(np.abs(model.shape_directions).max())
    if shown != "+x, +y, +z" or reach > 1.0:
        raise InputError(
            f"{file}: {'shapedirs' if reach > 1.0 else 'v_template'}",
            expected="a body whose left is +x, up +y, ahead +z, and shapes in metres",
            found=f"{shown}, and shapes that move points by up to {reach:.3g}",
            todo="Give SMPL's file as downloaded.",
        )


def body_path(name: str, folder: Path | None = None) -> Path:
    """Return the path of the installed model of that name, in `body_folder()` by default."""
    return (body_folder() if folder is None else folder.expanduser()) / f"{name}.npz"


def digest_of_body(name: str, folder: Path | None = None) -> str:
    """Return the SHA-256 of an installed model's file; UsageError if there is none."""
    return hashlib.sha256(_find_installed(name, folder).read_bytes()).hexdigest()


def find_body(
    name: str = OPEN_BODY, folder: Path | None = None, sha256: str | None = None
) -> BodyModel:
    """Return the open body or an installed one.

    Args:
        name: name of the model.
        folder: folder of installed bodies; `body_folder()` by default.
        sha256: digest of the installed file; None = any.

    Raises:
        UsageError: no body of that name is installed.
        InputError: its file is damaged, or has another digest.
    """
    if is_open_body(name):
        return load_open_body(name)
    if sha256 is not None and digest_of_body(name, folder) != sha256:
        raise InputError(
            f"body model {name}",
            expected=f"the file that the run was planned with, of SHA-256 {sha256[:12]}",
            found=f"another in {body_path('', folder).parent}",
            todo="Install that body model again on all machines, or run again with this one.",
        )
    return load_body(_find_installed(name, folder))


def _find_installed(name: str, folder: Path | None) -> Path:
    place = body_path("", folder).parent
    path = body_path(name, place)
    if not _NAME.fullmatch(name) or not path.is_file():
        installed = sorted(each.stem for each in place.glob("*.npz"))
        raise UsageError(
            f"body model {name!r}",
            expected=f"one of {', '.join([OPEN_BODY, NARROW_OPEN_BODY, *installed])}",
            found=f"none of that name in {place}",
            todo="Install it with worldpose body install FILE, name its folder in "
            f"{BODY_FOLDER_VARIABLE}, or take the open body.",
        )
    return path
