"""Camera and covariance from clicks and lines for an ill-conditioned problem (C4).

With two parallel lines and one across them, only the prior determines distance, height and focal
length; all other uncertainties are a thousand times smaller. The cameras that fit lie on a curve,
and its tangent is no approximation over that length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry import Camera
from worldpose.static_calibration.adjustment import Problem, row_of
from worldpose.static_calibration.curvature_correction import weighted
from worldpose.static_calibration.line_profiles import Bars
from worldpose.static_calibration.line_search import difference
from worldpose.static_calibration.parameters import CameraEstimate, stepped
from worldpose.static_calibration.residuals import SIZE

_TURNS: Final = 20
"""Gauss-Newton steps at most [1]."""
_SETTLED: Final = 0.01
"""Step length at which the iteration stops [standard deviations]."""
_HALVINGS: Final = 6
"""Maximum halvings of a step that does not lower the cost [1]."""
_FIRST: Final = 8
_DRAWS: Final = 64
"""Sampled cameras before the linearity test, and in total [1]."""
_STRAIGHT: Final = 0.3
"""Root mean square deviation of the first cameras from their tangents below which sampling stops
[standard deviations]."""


@dataclass(frozen=True, eq=False)
class ClicksAndBars:
    """Evidence of a camera after line refinement: clicks, prior and bars.

    Attributes:
        problem: the clicks and the prior.
        scale: factor on the stated noise of the clicks.
        bars: found on the lines.
    """

    problem: Problem
    scale: float
    bars: Bars

    def residuals(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return whitened residuals (m,) and derivatives (m, f) by the free parameters."""
        clicks, by_clicks = weighted(self.problem, row_of(camera), self.scale)
        lines, by_lines = self.bars.whitened(camera)
        rows = np.concatenate([by_clicks, by_lines])[:, self.problem.free]
        return np.concatenate([clicks, lines]), rows

    def fit(self, camera: Camera, noise: Floats | None = None) -> Camera:
        """Return the camera of least cost.

        Args:
            camera: near the answer.
            noise: (m,) to add to the residuals; None = none.
        """
        residuals, rows = self.residuals(camera)
        noise = np.zeros(len(residuals)) if noise is None else noise
        for _ in range(_TURNS):
            size = np.linalg.norm(rows, axis=0)
            step = np.zeros(SIZE)
            free_step = -np.linalg.lstsq(rows / size, residuals + noise)[0] / size
            before = float(((residuals + noise) ** 2).sum())
            for _ in range(_HALVINGS):
                step[self.problem.free] = free_step
                trial = stepped(camera, step)
                ahead, by_ahead = self.residuals(trial)
                # Points that a camera does not see are NaN, which compares false.
                if ((ahead + noise) ** 2).sum() < before:
                    break
                free_step = 0.5 * free_step
            else:
                return camera
            length = float(np.linalg.norm(rows @ free_step))
            camera, residuals, rows = trial, ahead, by_ahead
            if length < _SETTLED:
                break
        return camera


def fit_and_bends(problem: Problem, camera: Camera, bars: Bars, scale: float) -> CameraEstimate:
    """Return the camera fitted to clicks and lines, with a covariance to second order.

    The function samples noise of clicks, prior and bars, and fits a camera to each sample. To first
    order these cameras have the inverse information as covariance; the function adds the mean
    square of their deviations from the tangent.

    Args:
        problem: the inlying clicks.
        camera: near the answer.
        bars: bars on the lines.
        scale: factor on the stated noise of the clicks.
    """
    evidence = ClicksAndBars(problem, scale, bars)
    camera = evidence.fit(camera)
    rows = evidence.residuals(camera)[1]
    size = 1.0 / np.linalg.norm(rows, axis=0)
    answer = np.linalg.pinv(rows * size)
    covariance = answer @ answer.T
    # A fixed seed: the same evidence gives bitwise equal results.
    rng = np.random.default_rng(0)
    beside: list[Floats] = []
    for _ in range(_DRAWS // 2):
        noise = rng.standard_normal(len(rows))
        for sign in (1.0, -1.0):
            tangent = -sign * size * (answer @ noise)
            there = evidence.fit(camera, sign * noise)
            beside.append((difference(camera, there)[problem.free] - tangent) / size)
        if len(beside) == _FIRST:
            off = np.array(beside)
            if (off * np.linalg.solve(covariance, off.T).T).sum() < _FIRST * _STRAIGHT**2:
                break
    off = np.array(beside)
    whole = np.zeros((SIZE, SIZE))
    whole[np.ix_(problem.free, problem.free)] = (covariance + off.T @ off / len(off)) * np.outer(
        size, size
    )
    return CameraEstimate(camera, whole)
