"""Robust losses of a squared residual, and the weights of their reweighted least squares.

A loss is rho(e^2) with rho(e^2) = e^2 for small residuals and for an infinite scale; its weight is
d rho / d(e^2). Functions take numbers or arrays of squared residuals [variances], and a scale
[standard deviations].
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import inline_kernel

Number = TypeVar("Number", float, Floats)

MEDIAN_SQUARED = 2.0 * np.log(2.0)
"""Median squared length of a standard Gaussian in two dimensions [1]."""


@inline_kernel
def cauchy_loss(squared: Number, scale: float) -> Number:
    """Return c^2 log(1 + e^2 / c^2)."""
    if scale == np.inf:
        return squared + 0.0
    loss: Number = scale * scale * np.log1p(squared / (scale * scale))
    return loss


@inline_kernel
def cauchy_weight(squared: Number, scale: float) -> Number:
    """Return 1 / (1 + e^2 / c^2)."""
    return 1.0 / (1.0 + squared / (scale * scale))


@inline_kernel
def geman_mcclure_loss(squared: Number, scale: float) -> Number:
    """Return e^2 / (1 + e^2 / c^2), which is c^2 at most."""
    return squared / (1.0 + squared / (scale * scale))


@inline_kernel
def geman_mcclure_weight(squared: Number, scale: float) -> Number:
    """Return 1 / (1 + e^2 / c^2)^2."""
    share = 1.0 / (1.0 + squared / (scale * scale))
    return share * share
