"""Residuals between keypoints and the bodies that they were matched to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats

Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of keypoints, one row per detection; joints are those of the body.

    Attributes:
        frame: (n,)
        camera: (n,)
        person: (n,)
        missed: (n, 17, 2) vector from the body to the keypoint [px]; NaN = does not count.
        variance: (n, 17) of it per axis [px^2].
        repeated: rows of a person with correlated errors, which count as one.
    """

    frame: Places
    camera: Places
    person: Places
    missed: Floats
    variance: Floats
    repeated: float

    @property
    def weight(self) -> Floats:
        """(n, 17) [1/px^2]; 0 = does not count."""
        there = np.isfinite(self.missed).all(axis=-1) & np.isfinite(self.variance)
        return np.where(there, 1.0 / (np.where(there, self.variance, 1.0) * self.repeated), 0.0)

    def less(self, shift: Floats) -> Residuals:
        """Return the residuals minus a shift (n, 17, 2) [px]."""
        return replace(self, missed=self.missed - shift)
