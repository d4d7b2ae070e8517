"""The shape of a pitch's surface: crown and end fall, with what is known about them (C1).

The Laws say nothing about slopes. Builders let a pitch fall by 0.5 to 1 % from the center spot, to
the touch lines or to all sides, so that it drains. Where a survey has heights, they tell the shape;
otherwise painted lines in the images of static cameras do, and all cameras of a venue see the same
surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.pitch.template import PitchTemplate, law_points, surface_shape

PRIOR_STD_M: Final = np.array([0.1, 0.25])
"""Standard deviations of the crown about that of pitch.json, as in surveys, and of the end fall
[m]: 0.5 m are 1 % of half the length."""
_LEVEL_STD_M: Final = 0.02
"""Deviation of a surveyed height from the shape [m]: ground is uneven by 1 to 3 cm."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Crown and end fall of a pitch.

    Attributes:
        shape: (2,) crown: height of the long axis above the touch lines; end fall: height of the
            halfway line above the goal lines [m].
        covariance: (2, 2) [m^2].
    """

    shape: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def of(cls, pitch: PitchTemplate) -> Surface:
        """Return what is known of a pitch before any image: its template, and surveyed heights."""
        stated, information = pitch.surface, np.diag(PRIOR_STD_M**-2.0)
        laws = law_points(pitch.length, pitch.width)
        names = sorted(pitch.leveled & laws.keys())
        places = pitch.positions(names)
        rows = surface_shape(places[:, 0], places[:, 1], (pitch.length, pitch.width))
        above = places[:, 2] - [laws[name][2] for name in names] - rows @ stated
        covariance = np.asarray(np.linalg.inv(information + rows.T @ rows / _LEVEL_STD_M**2))
        return cls(stated + covariance @ rows.T @ above / _LEVEL_STD_M**2, covariance)

    def whiten(self, shape: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return whitened residuals (2,) of a shape (2,), and derivatives (2, 2) by it."""
        rows: NDArray[np.float64] = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return rows @ (shape - self.shape), rows
