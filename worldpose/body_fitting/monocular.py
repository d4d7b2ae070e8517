"""Monocular SMPL estimates, read from the files of the methods that make them (S4).

4DHumans (HMR2) and HybrIK estimate a body in each image crop: useful joint rotations, at a guessed
depth and size. Only the rotations and the image position are used. Every file is an npz of arrays;
the methods' own array names are supported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body.model import JOINTS
from worldpose.errors import InputError
from worldpose.formats.archives import read_npz
from worldpose.formats.files import require_file
from worldpose.geometry import Rigid

ESTIMATE_BYTES: Final = 1 << 30
"""Maximum size of the arrays of one file [byte]: 1.5 million bodies as matrices."""

WHOLE: Final = ("pred_thetas", "pred_theta_mats", "poses", "pose", "thetas")
"""Names of all 24 rotations in one array."""
ROOT: Final = ("global_orient", "pred_global_orient")
REST: Final = ("body_pose", "pred_body_pose")
"""Names of the pelvis' rotation and of the 23 others."""
CROPS: Final = ("box_center", "bbox", "bboxes")
"""Names of crops: centers, or x0 y0 x1 y1. Bodies of crops face the crop's center."""
PLACES: Final = ("transl", "pred_cam_t_full", "cam_t", "trans")
"""Names of positions in front of a whole image [m], of full perspective."""


@dataclass(frozen=True, eq=False)
class MonocularEstimates:
    """Bodies in the images of one camera, one row each."""

    frame: NDArray[np.int64]
    """(rows,)"""
    rotations: Floats
    """(rows, 24, 3, 3): of the pelvis, from the body to a camera (x right, y down, z forward) that
    looks at `center` if `cropped`, else along the optical axis; of the others, relative to the
    parent."""
    center: Floats
    """(rows, 2) [px], center of the body's box, or its position in the image."""
    cropped: bool


def read_monocular(path: Path) -> MonocularEstimates:
    """Return the bodies of an npz file of 4DHumans, HybrIK, or another SMPL estimator.

    Rotations are axis-angle vectors or matrices, in one array (`pred_thetas`, `poses`, ...) or two
    (`global_orient` and `body_pose`). The position of a body comes from its crop (`box_center`,
    `bbox`: weak perspective, whose scale and offset are not needed) or from its position in front
    of the camera (`transl` with `focal_length` and `img_size`: full perspective). `frame` gives the
    rows' frames; without it each row is a frame of its own.

    Args:
        path: written by `numpy.savez`; save the arrays of a pickle this way.

    Raises:
        InputError: unreadable, or without rotations or positions.
    """
    require_file(path)
    return monocular_of(read_npz(path, ESTIMATE_BYTES), path)


def monocular_of(arrays: Mapping[str, NDArray[Any]], where: Path) -> MonocularEstimates:
    """Return the bodies of arrays in the layout of such a file.

    Raises:
        InputError: arrays are missing or have wrong shapes; the error names `where`.
    """
    whole = _first(arrays, WHOLE)
    if whole is None:
        root, rest = _first(arrays, ROOT), _first(arrays, REST)
        if root is None or rest is None:
            expected = f"{' or '.join(WHOLE)}; or {ROOT[0]} and {REST[0]}"
            raise _wrong(where, expected, ", ".join(arrays) or "nothing")
        parts = [_turns(root, where, ROOT[0], 1), _turns(rest, where, REST[0], JOINTS - 1)]
        if len(parts[0]) != len(parts[1]):
            raise _wrong(where, "as many pelves as bodies", f"{len(parts[0])} and {len(parts[1])}")
        rotations = np.concatenate(parts, axis=1)
    else:
        rotations = _turns(whole, where, "turns", JOINTS)
    rows = len(rotations)
    frame = np.asarray(arrays.get("frame", arrays.get("frames", np.arange(rows)))).ravel()
    crop, place = _first(arrays, CROPS), _first(arrays, PLACES)
    if crop is not None:
        crop = np.asarray(crop, dtype=np.float64)
        center = crop if crop.shape[1:] == (2,) else 0.5 * (crop[..., :2] + crop[..., 2:4])
    elif place is not None and "focal_length" in arrays and "img_size" in arrays:
        focal = np.broadcast_to(np.asarray(arrays["focal_length"]).reshape(-1, 1), (rows, 1))
        size = np.broadcast_to(np.asarray(arrays["img_size"]).reshape(-1, 2), (rows, 2))
        place = np.asarray(place, dtype=np.float64).reshape(rows, 3)
        with np.errstate(divide="ignore", invalid="ignore"):
            center = focal * place[:, :2] / place[:, 2:] + 0.5 * (size - 1.0)
    else:
        expected = "a crop (box_center or bbox), or transl with focal_length and img_size"
        raise _wrong(where, expected, ", ".join(arrays))
    if len(frame) != rows or center.shape != (rows, 2):
        raise _wrong(where, f"{rows} frames and places", f"{len(frame)} and {center.shape}")
    return MonocularEstimates(frame.astype(np.int64), rotations, center, crop is not None)


def _first(arrays: Mapping[str, NDArray[Any]], names: tuple[str, ...]) -> NDArray[Any] | None:
    return next((arrays[name] for name in names if name in arrays), None)


def _turns(given: NDArray[Any], where: Path, name: str, joints: int) -> Floats:
    """Return matrices (rows, joints, 3, 3) of axis-angle vectors or matrices of any shape."""
    values = np.asarray(given, dtype=np.float64)
    rows, numbers = values.shape[:1], int(np.prod(values.shape[1:]))
    if values.ndim > 1 and numbers == 9 * joints:
        matrices: Floats = values.reshape(*rows, joints, 3, 3)
        return matrices
    if values.ndim > 1 and numbers == 3 * joints:
        return Rigid.from_rotvec(values.reshape(*rows, joints, 3), np.zeros(3)).rotation
    expected = f"{name} of {joints} joints, axis-angle vectors or matrices, for each row"
    raise _wrong(where, expected, f"shape {values.shape}")


def _wrong(where: Path, expected: str, found: str) -> InputError:
    return InputError(
        str(where),
        expected=expected,
        found=found,
        todo="Save the method's arrays with numpy.savez, one row for each body and picture.",
    )
