"""Noise of painted lines, learned from the residuals of one image (C4).

Paint deviates from the template by centimetres on real pitches: ground and paint are uneven over a
few metres. On a camera 8 m up and 50 m away, 2 cm of height are a pixel. A survey by total station
leaves millimetres. So the residuals decide: the unevenness and the error of a reading by empirical
Bayes (MacKay 1992, "Bayesian interpolation"), with stated minima.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers

FIRST_KNOT: Final = -1_000_000
"""Number of the first knot's unknown; others follow downwards."""
_PRIOR_WEIGHT: Final = 4.0
"""Degrees of freedom of a standard deviation before the residuals [1]."""
_MAX_UNKNOWN: Final = 3.0
"""Value of an unknown [standard deviations] beyond which it is an outlier for the noise."""
_MIN_UNEVENNESS_M: Final = 0.0002
"""Below, errors of readings are larger in any image [m]."""
_MAX_UNEVENNESS_M: Final = 0.1
"""Largest unevenness [m]; beyond, lines have wrong names."""
_MAX_READING: Final = 8.0
_GAUSSIAN_MEDIAN: Final = 0.6745
"""Median absolute value of a standard Gaussian."""


@dataclass(frozen=True)
class PaintNoise:
    """Standard deviations of the paint from the template, and of its detection.

    Attributes:
        points_m: standard deviation of the points that define markings, each axis [m].
        unevenness_m: standard deviation of paint and ground at knots along a marking, across it and
            in height [m].
        shift_px: standard deviation of the shift of a whole marking in the image [px].
        reading: factor on the standard deviation of a fitted bar [1].
    """

    points_m: float
    unevenness_m: float
    shift_px: float
    reading: float

    def differs_from(self, other: PaintNoise, share: float) -> bool:
        """Return whether a standard deviation differs from another's by more than a share."""
        return bool(np.abs(np.divide(astuple(self), astuple(other)) - 1.0).max() >= share)

    def update(self, least: PaintNoise, paint: PaintUnknowns, residuals: Floats) -> PaintNoise:
        """Return the noise after one step of the evidence maximization.

        Args:
            least: the minimum, and the prior.
            paint: unknowns of a fit with this noise.
            residuals: (n,) residuals of this fit, in standard deviations of the present reading.
        """
        mine = paint.numbers <= FIRST_KNOT
        squares = float(np.minimum(paint.values[mine] ** 2, _MAX_UNKNOWN**2).sum())
        total = _PRIOR_WEIGHT * least.unevenness_m**2 + squares * self.unevenness_m**2
        uneven = float(np.sqrt(total / (_PRIOR_WEIGHT + paint.freedom[mine].sum())))
        middle = float(np.median(np.abs(residuals))) if len(residuals) else _GAUSSIAN_MEDIAN
        return replace(
            self,
            unevenness_m=float(np.clip(uneven, least.unevenness_m, _MAX_UNEVENNESS_M)),
            reading=float(np.clip(self.reading * middle / _GAUSSIAN_MEDIAN, 1.0, _MAX_READING)),
        )


EXACT_PAINT: Final = PaintNoise(points_m=0.0, unevenness_m=0.0, shift_px=0.0, reading=1.0)
"""Paint where the template has it."""


@dataclass(frozen=True, eq=False)
class PaintUnknowns:
    """Unknowns of the paint after a fit.

    Attributes:
        numbers: (k,) rising, see `ProjectedLines`.
        values: (k,) values in standard deviations of their prior.
        freedom: (k,) degrees of freedom that the samples determine of each, 0 to 1.
    """

    numbers: Integers
    values: Floats
    freedom: Floats


def stated_noise(survey_error: float, shift: float) -> PaintNoise:
    """Return the noise of a surveyed pitch without unevenness: the minimum.

    Args:
        survey_error: survey error of the points that define markings, each axis, standard deviation
            [m].
        shift: shift of a whole marking in the image, standard deviation [px].
    """
    return PaintNoise(max(survey_error, 1e-6), _MIN_UNEVENNESS_M, max(shift, 1e-6), 1.0)
