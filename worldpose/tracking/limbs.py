"""Body size: limb lengths relative to an adult's, and limb lengths over a track."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_BODY_BONES

LIMBS = np.array(COCO17_BODY_BONES)
"""Pairs of COCO-17 joints whose distances measure a person's size."""
ADULT_LENGTHS = np.array([0.36, 0.30, 0.30, 0.25, 0.25, 0.51, 0.51, 0.42, 0.42, 0.42, 0.42])
"""Lengths of `LIMBS` in an adult of 1.75 m [m]: Drillis and Contini's segment ratios, with the
torso and shoulders measured between joint centres."""
ERROR_TIME = 0.3
"""Correlation time of a detector's errors [s]: frames nearer to each other add no information."""


def size_ratios(joints: Floats) -> Floats:
    """Return the limb lengths (..., 11) of joints (..., 17, 3) [m] over those of an adult [1]."""
    ends = joints[..., LIMBS[:, 0], :], joints[..., LIMBS[:, 1], :]
    return np.asarray(np.linalg.norm(ends[0] - ends[1], axis=-1) / ADULT_LENGTHS)


def has_adult_size(joints: Floats, size_range: tuple[float, float]) -> bool:
    """Return whether joints (17, 3) [m] have the size of a person: the median over known limbs."""
    ratios = size_ratios(joints)
    ratios = ratios[np.isfinite(ratios)]
    low, high = size_range
    return bool(len(ratios)) and low <= float(np.median(ratios)) <= high


def limb_lengths(joints: Floats, fps: float) -> tuple[Floats, Floats]:
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
