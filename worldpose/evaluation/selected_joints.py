"""Joint subsets of the paper and the challenge, from COCO-17."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17

LIMB_JOINTS: Final = COCO17[5:]
"""Shoulders, elbows, wrists, hips, knees and ankles, left before right."""


def paper_joints(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the joints of E4 (..., 14, 3) [m], NaN where missing.

    Args:
        joints: (..., 17, 3) [m], COCO-17.
    """
    neck = joints[..., 5:7, :].mean(axis=-2, keepdims=True)
    return np.concatenate([joints[..., :1, :], neck, joints[..., 5:, :]], axis=-2)


def challenge_joints(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the joints that the challenge and COCO-17 share (..., 13, 3) [m].

    Args:
        joints: (..., 17, 3) [m], COCO-17.
    """
    return np.concatenate([joints[..., :1, :], joints[..., 5:, :]], axis=-2)


def mid_hip(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the middle of the hips (..., 3) [m], NaN if one is missing.

    Args:
        joints: (..., 17, 3) [m], COCO-17.
    """
    middle: NDArray[np.float64] = joints[..., 11:13, :].mean(axis=-2)
    return middle
