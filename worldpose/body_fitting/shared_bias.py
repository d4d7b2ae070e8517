"""What a detector always gets wrong: offsets of joints along the axes of the body.

Training labels have an idea of each joint that is not the body model's, the same for all people and
cameras, and mirrored from left to right. No number of views removes it; bones of constant length
that turn, and bodies of human proportions, tell it from the pose.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17

Floats = NDArray[np.float64]


def _basis() -> Floats:
    """Offsets (17, 3, unknowns) by unknowns: forward, left and up of each joint or pair."""
    columns = []
    for joint, name in enumerate(COCO17):
        if name.startswith("right"):
            continue
        mirrored = COCO17.index(name.replace("left", "right"))
        # The middle of a body that is its own mirror image is in its middle.
        for axis in (0, 1, 2) if mirrored != joint else (0, 2):
            column = np.zeros((len(COCO17), 3))
            column[joint, axis] = 1.0
            column[mirrored, axis] = -1.0 if axis == 1 else 1.0
            columns.append(column)
    return np.stack(columns, axis=-1)


MIRRORED_OFFSETS: Final = _basis()
"""(17, 3, 26)"""


def body_axes(joints: Floats) -> Floats:
    """Return columns forward, left and up (..., 3, 3) of bodies whose joints are (..., 17, 3).

    Left is that of hips and shoulders, up that of the trunk.
    """
    left = joints[..., 5, :] + joints[..., 11, :] - joints[..., 6, :] - joints[..., 12, :]
    up = joints[..., 5, :] + joints[..., 6, :] - joints[..., 11, :] - joints[..., 12, :]
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    front = np.cross(left, up)
    front /= np.linalg.norm(front, axis=-1, keepdims=True)
    axes: Floats = np.stack([front, left, np.cross(front, left)], axis=-1)
    return axes
