"""Ten limbs of PCP3D on COCO-17 joints, and their correctness."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

LIMBS: Final = {
    "left upper arm": ((5,), (7,)),
    "left lower arm": ((7,), (9,)),
    "right upper arm": ((6,), (8,)),
    "right lower arm": ((8,), (10,)),
    "left upper leg": ((11,), (13,)),
    "left lower leg": ((13,), (15,)),
    "right upper leg": ((12,), (14,)),
    "right lower leg": ((14,), (16,)),
    "torso": ((11, 12), (5, 6)),
    "head": ((5, 6), (3, 4)),
}
"""Each end is the mean of the named COCO-17 joints: torso from mid-hip to mid-shoulder, head from
mid-shoulder to the middle of the ears."""


def limb_ends(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return both ends of every limb, NaN where a joint is missing.

    Args:
        joints: (..., 17, 3) [m].

    Returns:
        (..., 10, 2, 3) [m], in the order of `LIMBS`.
    """
    return np.stack(
        [
            np.stack([joints[..., list(end), :].mean(axis=-2) for end in ends], axis=-2)
            for ends in LIMBS.values()
        ],
        axis=-3,
    )


def correct_limbs(
    predicted: NDArray[np.float64], true: NDArray[np.float64], alpha: float
) -> NDArray[np.bool_]:
    """Return a mask of correct limbs (..., 10): mean error of ends at most alpha times length.

    Args:
        predicted: (..., 17, 3) [m]; a limb with a missing joint is wrong.
        true: (..., 17, 3) [m].
        alpha: share of the true length.

    Note:
        Burenius et al., CVPR 2013, in the form used for Shelf and Campus: the mean of both errors
        is below the bound, not each error as in the original form.
    """
    true_ends = limb_ends(true)
    error = np.linalg.norm(limb_ends(predicted) - true_ends, axis=-1).mean(axis=-1)
    length = np.linalg.norm(true_ends[..., 0, :] - true_ends[..., 1, :], axis=-1)
    correct: NDArray[np.bool_] = error <= alpha * length
    return correct
