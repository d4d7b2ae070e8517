"""Systematic offsets of a detector's joints along the axes of the body.

Training labels define joints differently than the body model, the same way for all people and
cameras, and mirrored from left to right. No number of views removes these offsets; rotating bones
of constant length, and human proportions, separate them from the pose.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17


def _basis() -> Floats:
    """Return offsets (17, 3, unknowns) by unknowns: forward, left and up of each joint or pair."""
    columns = []
    for joint, name in enumerate(COCO17):
        if name.startswith("right"):
            continue
        mirrored = COCO17.index(name.replace("left", "right"))
        # A joint that is its own mirror image lies in the middle plane.
        for axis in (0, 1, 2) if mirrored != joint else (0, 2):
            column = np.zeros((len(COCO17), 3))
            column[joint, axis] = 1.0
            column[mirrored, axis] = -1.0 if axis == 1 else 1.0
            columns.append(column)
    return np.stack(columns, axis=-1)


MAX_OFFSET: Final = 3.0
"""Offsets beyond this are unusual for any detector [standard deviations]: one in 34."""
MIRRORED_OFFSETS: Final = _basis()
"""(17, 3, 26)"""


def body_axes(joints: Floats) -> Floats:
    """Return columns forward, left and up (..., 3, 3) of bodies whose joints are (..., 17, 3).

    Left follows hips and shoulders, up follows the trunk.
    """
    left = joints[..., 5, :] + joints[..., 11, :] - joints[..., 6, :] - joints[..., 12, :]
    up = joints[..., 5, :] + joints[..., 6, :] - joints[..., 11, :] - joints[..., 12, :]
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    front = np.cross(left, up)
    front /= np.linalg.norm(front, axis=-1, keepdims=True)
    axes: Floats = np.stack([front, left, np.cross(front, left)], axis=-1)
    return axes


def far_offsets(offsets: Floats, common_bias: Floats) -> dict[str, tuple[float, float]]:
    """Return the joints of bodies with unusually large offsets.

    Shape and offsets together follow the detector: an offset much larger than a detector's common
    bias means that either the joints or the bodies are wrong.

    Args:
        offsets: (17, 3) [m], of joints of bodies.
        common_bias: (17,) per axis [m]; 0 = not known.

    Returns:
        By joint, left and right as one: length of the offset and its usual maximum [m].
    """
    length = np.linalg.norm(offsets, axis=-1)
    far = (length > MAX_OFFSET * common_bias) & (common_bias > 0.0)
    return {
        COCO17[joint].removeprefix("left_"): (
            float(length[joint]),
            MAX_OFFSET * float(common_bias[joint]),
        )
        for joint in np.flatnonzero(far)
        if not COCO17[joint].startswith("right")
    }
