"""A camera from clicks and lines where these leave a long valley of cameras that fit (C4).

Two parallel lines and one across them leave distance, height and focal length to the prior, and
hold all else to a thousandth of that. The cameras that fit lie on a curve that no tangent follows
so far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.cameras import Camera
from worldpose.static_calibration.adjustment import Problem, row_of
from worldpose.static_calibration.curvature_correction import weighted
from worldpose.static_calibration.line_profiles import Bars
from worldpose.static_calibration.line_search import difference
from worldpose.static_calibration.parameters import CameraEstimate, stepped
from worldpose.static_calibration.residuals import SIZE

Floats = NDArray[np.float64]

_TURNS: Final = 20
"""Gauss-Newton steps at most [1]."""
_SETTLED: Final = 0.01
"""Length of the last of them [standard deviations]."""
_HALVINGS: Final = 6
"""Times that a step may be halved until the fit is better [1]."""
_FIRST: Final = 8
_DRAWS: Final = 64
"""Cameras that tell whether more are needed, and all of them [1]."""
_STRAIGHT: Final = 0.3
"""Root mean square distance of the first from their tangents that needs no more of them [standard
deviations]."""


@dataclass(frozen=True, eq=False)
class ClicksAndBars:
    """All that a camera rests on after its lines.

    Attributes:
        problem: the clicks and the prior.
        scale: factor on the stated noise of the clicks.
        bars: found on the lines.
    """

    problem: Problem
    scale: float
    bars: Bars

    def residuals(self, camera: Camera) -> tuple[Floats, Floats]:
        """Return residuals (m,) in standard deviations, and derivatives (m, f) by a free step."""
        clicks, by_clicks = weighted(self.problem, row_of(camera), self.scale)
        lines, by_lines = self.bars.whitened(camera)
        rows = np.concatenate([by_clicks, by_lines])[:, self.problem.free]
        return np.concatenate([clicks, lines]), rows

    def fit(self, camera: Camera, noise: Floats | None = None) -> Camera:
        """Return the best camera.

        Args:
            camera: near the answer.
            noise: added to the residuals (m,).
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
                # What a camera does not see is NaN, and no better.
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
    """Return the camera that clicks and lines agree on, its covariance wide enough for its valley.

    Noise as large as that of clicks, prior and bars is drawn, and a camera fitted to it. By the
    tangents these cameras have the inverse of the information as covariance; the mean square of
    what they lie beside their tangents is added to it.

    Args:
        problem: the clicks that the camera rests on.
        camera: near the answer.
        bars: found on the lines.
        scale: factor on the stated noise of the clicks.
    """
    evidence = ClicksAndBars(problem, scale, bars)
    camera = evidence.fit(camera)
    rows = evidence.residuals(camera)[1]
    size = 1.0 / np.linalg.norm(rows, axis=0)
    answer = np.linalg.pinv(rows * size)
    covariance = answer @ answer.T
    # The same noise for every camera: the same evidence gives the same bits.
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
