"""Spread of detected keypoints about correct bodies, learned per clip."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats

BINS: Final = 8
"""Confidence classes."""
ROUNDS: Final = 6
"""Iterations; the last changes a factor by less than a hundredth."""
MEDIAN: Final = 2.0 * math.log(2.0)
"""Median squared distance in two dimensions, in variances of an axis."""
LEAST: Final = 0.05
"""Smallest factor: bodies that follow their keypoints exactly must not create outliers."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Factors on the stated variance of keypoints about their bodies.

    Attributes:
        joint: (17,)
        knots: (bins - 1,) confidences that separate the classes.
        confidence: (bins,) by class.
    """

    joint: Floats
    knots: Floats
    confidence: Floats

    def factor(self, confidence: NDArray[np.floating]) -> Floats:
        """Return the factors of keypoints with these confidences (..., 17)."""
        place = np.searchsorted(self.knots, confidence, side="right")
        return np.asarray(self.confidence[place] * self.joint)


def learn_spread(squared: Floats, stated: Floats, known: Floats, confidence: Floats) -> Spread:
    """Return the spread of keypoints about bodies, from medians, which outliers hardly move.

    Args:
        squared: (n, 17) squared distance of each keypoint to its body [px^2]; NaN = none.
        stated: (n, 17) stated variance of keypoints per axis [px^2].
        known: (n, 17) variance of the body's joint per axis [px^2].
        confidence: (n, 17).
    """
    seen = np.isfinite(squared) & np.isfinite(known)
    sure = confidence[seen]
    if not len(sure):
        return Spread(np.ones(squared.shape[1]), np.empty(0), np.ones(1))
    knots = np.unique(np.quantile(sure, np.linspace(0.0, 1.0, BINS + 1)[1:-1]))
    bins = np.searchsorted(knots, sure, side="right")
    joints = np.broadcast_to(np.arange(squared.shape[1]), squared.shape)[seen]
    squares, base, given = squared[seen], stated[seen], known[seen]
    by_bin, by_joint = np.ones(len(knots) + 1), np.ones(squared.shape[1])
    for _ in range(ROUNDS):
        for group, factor in ((bins, by_bin), (joints, by_joint)):
            expected = by_bin[bins] * by_joint[joints] * base
            ratio = squares / (expected + given)
            for each in np.unique(group):
                mine = group == each
                median = float(np.median(ratio[mine])) / MEDIAN
                # The factor excludes the variance of the body.
                share = float(np.median((expected / (expected + given))[mine]))
                factor[each] = max(LEAST, factor[each] * (1.0 + (median - 1.0) / max(share, 0.3)))
    return Spread(by_joint, knots, by_bin)
