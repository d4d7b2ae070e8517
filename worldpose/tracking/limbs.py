"""Limb lengths of adults, and of the person of a track."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LIMBS = np.array(
    [
        (5, 6),
        (5, 7),
        (6, 8),
        (7, 9),
        (8, 10),
        (5, 11),
        (6, 12),
        (11, 13),
        (12, 14),
        (13, 15),
        (14, 16),
    ]
)
"""Pairs of COCO-17 joints whose distances measure a person's size."""
LIMB_LENGTHS = np.array([0.36, 0.30, 0.30, 0.25, 0.25, 0.51, 0.51, 0.42, 0.42, 0.42, 0.42])
"""Their lengths in an adult of 1.75 m [m]: Drillis and Contini's segment ratios, with the torso
and shoulders measured between joint centres."""
ERROR_TIME = 0.3
"""Correlation time of a detector's errors [s]: frames nearer to each other add no information."""


def plausible(joints: NDArray[np.float64], size_range: tuple[float, float]) -> bool:
    """Return whether joints (17, 3) [m] have the size of a person: the median over known limbs."""
    lengths = np.linalg.norm(joints[LIMBS[:, 0]] - joints[LIMBS[:, 1]], axis=-1)
    ratios = (lengths / LIMB_LENGTHS)[np.isfinite(lengths)]
    low, high = size_range
    return bool(len(ratios)) and low <= float(np.median(ratios)) <= high


def limb_lengths(
    joints: NDArray[np.float64], fps: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return median limb lengths (11,) [m] over a track and their variance (11,) [m^2].

    Args:
        joints: (n, 17, 3) [m], world; NaN where not determined.
        fps: frames per second [1/s].

    Returns:
        NaN for limbs never determined.
    """
    lengths = np.linalg.norm(joints[:, LIMBS[:, 0]] - joints[:, LIMBS[:, 1]], axis=-1)
    median, variance = np.full(len(LIMBS), np.nan), np.full(len(LIMBS), np.nan)
    for limb, every in enumerate(lengths.T):
        known = every[np.isfinite(every)]
        if len(known):
            median[limb] = np.median(known)
            # 5 cm for a single frame, else the scatter between frames if larger.
            spread = max(0.05, 1.4826 * float(np.median(np.abs(known - median[limb]))))
            variance[limb] = spread**2 / max(1.0, len(known) / (ERROR_TIME * fps))
    return median, variance
