"""Robust least squares of a camera on measured lines, with a prior (C4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compiled


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A step of the free parameters, its information and its residuals.

    Attributes:
        step: (f,).
        information: (f, f) inverse covariance of the step, marginalized over the paint's unknowns.
        residuals: (n,) after subtraction of the paint's unknowns [px].
        weights: (n,) of the robust loss [1].
        spent: degrees of freedom that the fit takes from the samples [1].
    """

    step: Floats
    information: Floats
    residuals: Floats
    weights: Floats
    spent: float


def adjust(
    offsets: Floats,
    variances: Floats,
    by_camera: Floats,
    by_paint: Floats,
    unknowns: Integers,
    prior: tuple[Floats, Floats],
    scales: tuple[float, ...],
) -> Adjusted:
    """Return the step that moves projected markings onto measured ones.

    Iteratively reweighted least squares with the Geman-McClure loss. The paint's unknowns have unit
    Gaussian priors: a thousand samples of one line determine its paint, but the camera only within
    the survey error of the line's ends.

    Args:
        offsets: (n,) measured minus projected, along the normal [px]; NaN = no measurement.
        variances: (n,) [px^2].
        by_camera: (n, f) derivatives of the projection by the free parameters.
        by_paint: (n, k) derivatives of the projection by unknowns of the paint.
        unknowns: (n, k) indices of these unknowns.
        prior: information (f, f) and mean (f,) of the step.
        scales: of the loss [standard deviations], one per iteration.
    """
    known = np.isfinite(offsets)
    weights = known.astype(np.float64)
    numbers, index = np.unique(unknowns, return_inverse=True)
    free = by_camera.shape[1]
    size = free + len(numbers)
    shift = np.where(known, offsets, 0.0)
    solution = np.zeros(size)
    normal = np.empty((size, size))
    told = np.empty((size, size))
    residuals = shift
    for scale in scales:
        if scale < np.inf:
            squared = residuals**2 / variances / scale**2
            weights = np.where(known, 1.0 / (1.0 + squared) ** 2, 0.0)
        normal[:] = 0.0
        right = np.zeros(size)
        _accumulate(shift, weights / variances, by_camera, by_paint, index, normal, right)
        told[:] = normal
        normal[:free, :free] += prior[0]
        right[:free] += prior[0] @ prior[1]
        normal[np.arange(free, size), np.arange(free, size)] += 1.0
        solution = np.linalg.solve(normal, right)
        residuals = shift - by_camera @ solution[:free]
        residuals -= (by_paint * solution[free:][index]).sum(axis=1)
    corner = normal[:free, free:]
    information = normal[:free, :free] - corner @ np.linalg.solve(normal[free:, free:], corner.T)
    spent = float(np.trace(np.linalg.solve(normal, told)))
    return Adjusted(solution[:free], 0.5 * (information + information.T), residuals, weights, spent)


@compiled
def _accumulate(
    shift: Floats,
    weights: Floats,
    by_camera: Floats,
    by_paint: Floats,
    index: Integers,
    normal: Floats,
    right: Floats,
) -> None:
    """Add the samples to the normal equations: the camera first, then the paint's unknowns."""
    free, paints = by_camera.shape[1], by_paint.shape[1]
    for i in range(len(shift)):
        w = weights[i]
        if w == 0.0:
            continue
        for a in range(free):
            left = w * by_camera[i, a]
            right[a] += left * shift[i]
            for b in range(free):
                normal[a, b] += left * by_camera[i, b]
            for b in range(paints):
                normal[a, free + index[i, b]] += left * by_paint[i, b]
                normal[free + index[i, b], a] += left * by_paint[i, b]
        for a in range(paints):
            left = w * by_paint[i, a]
            right[free + index[i, a]] += left * shift[i]
            for b in range(paints):
                normal[free + index[i, a], free + index[i, b]] += left * by_paint[i, b]
