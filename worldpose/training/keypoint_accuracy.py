"""Accuracy of keypoints (PCK) and calibration of their confidence."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, Floats

SHARE: Final = 0.2
"""Share of the torso within which a keypoint is correct [1]."""


def torso_sizes(keypoints: Floats) -> Floats:
    """Return the longer diagonal from a shoulder to the other side's hip (people,) [px].

    Args:
        keypoints: (people, 17, 2) COCO-17 [px].
    """
    diagonals = keypoints[:, (5, 6)] - keypoints[:, (12, 11)]
    return np.asarray(np.linalg.norm(diagonals, axis=-1).max(axis=-1))


def correct_keypoints(found: AnyFloats, true: Floats, share: float = SHARE) -> Floats:
    """Return 1 for keypoints within a share of the torso, else 0 (people, 17); NaN without truth.

    Args:
        found: (people, 17, 2) [px]; a missing one is not correct.
        true: (people, 17, 2) [px]; NaN where unknown.
        share: of the torso [1].
    """
    error = np.linalg.norm(found - true, axis=-1)
    torso = torso_sizes(true)
    known = np.isfinite(true).all(axis=-1) & np.isfinite(torso)[:, None]
    return np.where(known, error <= share * torso[:, None], np.nan)


def calibration_error(confidence: Floats, right: NDArray[np.bool_], classes: int = 10) -> float:
    """Return the mean gap between confidence and share of correct ones [1], over equal bins.

    Args:
        confidence: (keypoints,) in (0, 1].
        right: (keypoints,)
        classes: bins of confidence, with equally many keypoints each.
    """
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, min(classes, len(order)))
    gaps = [abs(confidence[part].mean() - right[part].mean()) * len(part) for part in parts]
    return float(np.sum(gaps) / len(order))
