"""Installation of a user's body model, such as SMPL, whose licence forbids shipping it."""

from __future__ import annotations

import hashlib
import re
import zipfile
from pathlib import Path
from typing import Final

from worldpose.body.body_file import (
    KEYS,
    OPEN_BODY,
    load_body,
    load_open_body,
    model_of,
    read_arrays,
    save_body,
)
from worldpose.body.model import POSE_FEATURES, SMPL_VERTICES, BodyModel
from worldpose.body.pickled_arrays import read_pickled_arrays
from worldpose.errors import InputError, UsageError

BODY_FOLDER: Final = Path("~/.local/share/worldpose/bodies")
"""Default folder of installed bodies."""

_NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]*")


def install_body(file: Path, folder: Path = BODY_FOLDER, name: str | None = None) -> BodyModel:
    """Return a model read from SMPL's own file, after saving it as a safe npz file.

    Args:
        file: SMPL's .pkl or .npz, as downloaded. Only its first 10 shape directions are used. The
            pickle's content is read, never run (`pickled_arrays`).
        folder: where `<name>.npz` is written; one of the same name is replaced.
        name: name of the model in results; from the file's name by default, so that
            SMPL_NEUTRAL.pkl becomes smpl-neutral.

    Raises:
        InputError: the file is not a body model in SMPL's layout, or names code to run.
        UsageError: the name is invalid.
    """
    model_name = name or file.stem.lower().replace("_", "-")
    if not _NAME.fullmatch(model_name):
        raise UsageError(
            f"name of the body model {model_name!r}",
            expected="small letters, digits, dots and hyphens",
            found=repr(model_name),
            todo="Give another name with --name.",
        )
    reader = read_arrays if zipfile.is_zipfile(file) else read_pickled_arrays
    model = model_of(reader(file, KEYS), model_name, file)
    counts = len(model.template), model.pose_directions.shape[-1], model.shapes > 0
    if counts != (SMPL_VERTICES, POSE_FEATURES, True):
        raise InputError(
            str(file),
            expected=f"{SMPL_VERTICES} vertices, {POSE_FEATURES} pose and some shape directions",
            found=f"{counts[0]}, {counts[1]} and {model.shapes}",
            todo="Take SMPL's file, not that of SMPL-H, SMPL-X or another model.",
        )
    path = body_path(model_name, folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_body(path, model)
    return load_body(path)


def body_path(name: str, folder: Path = BODY_FOLDER) -> Path:
    """Return the path of the installed model of that name."""
    return folder.expanduser() / f"{name}.npz"


def digest_of_body(name: str, folder: Path = BODY_FOLDER) -> str:
    """Return the SHA-256 of an installed model's file.

    Raises:
        UsageError: no body of that name is installed.
    """
    return hashlib.sha256(_installed(name, folder).read_bytes()).hexdigest()


def find_body(name: str = OPEN_BODY, folder: Path = BODY_FOLDER) -> BodyModel:
    """Return the open body or an installed one.

    Raises:
        UsageError: no body of that name is installed.
        InputError: its file is damaged.
    """
    if name == OPEN_BODY:
        return load_open_body()
    return load_body(_installed(name, folder))


def _installed(name: str, folder: Path) -> Path:
    path = body_path(name, folder)
    if not _NAME.fullmatch(name) or not path.is_file():
        installed = sorted(each.stem for each in folder.expanduser().glob("*.npz"))
        raise UsageError(
            f"body model {name!r}",
            expected=f"one of {', '.join([OPEN_BODY, *installed])}",
            found="none of that name",
            todo="Install one with worldpose body install FILE, or take the open body.",
        )
    return path
