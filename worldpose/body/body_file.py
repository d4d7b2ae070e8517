"""Body models as npz files: arrays under SMPL's own keys and a name; never a pickle."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body.model import BodyModel
from worldpose.errors import InputError

OPEN_BODY: Final = "open-neutral/2"
"""The body that ships with worldpose: SMPL's layout, not SMPL (docs/body_model.md)."""

KEYS: Final = (
    "v_template",
    "shapedirs",
    "posedirs",
    "J_regressor",
    "weights",
    "kintree_table",
    "f",
)
"""Names of a model's arrays in SMPL's files."""

_SHAPES: Final = 10
"""Number of betas that are read, as in the released poses (X3)."""


def load_open_body() -> BodyModel:
    """Return the open body: 6890 vertices, 24 joints, 10 betas, free for any use (CC0)."""
    return load_body(Path(__file__).parent / "open_body.npz")


def load_body(path: Path) -> BodyModel:
    """Return the body model of a file that `save_body` wrote.

    Raises:
        InputError: the file is missing, damaged or no body model.
    """
    arrays = read_arrays(path, (*KEYS, "name"))
    return model_of(arrays, str(arrays["name"]), path)


def save_body(path: Path, model: BodyModel) -> None:
    """Write a model in single precision, to 0.1 um; the file appears complete or not at all."""
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
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_arrays(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Return arrays of an npz file; Python objects in it are refused unread.

    Raises:
        InputError: the file is missing or damaged, or lacks a key.
    """
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("a single array")
        with file:
            return {key: file[key] for key in keys}
    except KeyError as error:
        raise unreadable(path, f"none named {error}") from None
    except (OSError, EOFError, ValueError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise unreadable(path, f"what cannot be read ({error})") from None


def unreadable(path: Path, found: str) -> InputError:
    """Return the error of a file that is not a body model."""
    return InputError(
        str(path),
        expected=f"a body model with the arrays {', '.join(KEYS)}",
        found=found,
        todo="Give SMPL's own .pkl or .npz to worldpose body install.",
    )


def model_of(arrays: Mapping[str, NDArray[np.generic]], name: str, path: Path) -> BodyModel:
    """Return the model of a file's arrays.

    Raises:
        InputError: the arrays are not a body model's.
    """
    for key, array in arrays.items():
        dimensions = 3 if key in ("shapedirs", "posedirs") else 2
        kinds = "iu" if key in ("kintree_table", "f") else "fiu"
        if key in KEYS and (array.ndim != dimensions or array.dtype.kind not in kinds):
            raise unreadable(path, f"{key} of shape {array.shape} and type {array.dtype}")
    parents = arrays["kintree_table"][:1].astype(np.int64).ravel()
    try:
        return BodyModel(
            name=name,
            template=arrays["v_template"].astype(np.float64),
            shape_directions=arrays["shapedirs"][:, :, :_SHAPES].astype(np.float64),
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
