"""Which clicks are wrong, and how large the noise of the others is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.static_calibration.adjustment import Fits, Problem, adjust, row_of
from worldpose.static_calibration.bending import with_bends
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.residuals import drawn_residuals, point_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings

_ROBUST: Final = 3.0
"""Cauchy scale of clicks [standard deviations] of the fit that the screening starts from."""
_SINGULAR: Final = 1e-14
"""Least eigenvalue of the scaled information [1]: below it a point lies in the camera's center,
and rounding decides."""
_OWN_WORTH: Final = 40.0
"""Residuals that the stated noise is worth when the noise is estimated [1]: a few clicks cannot
overrule it."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Residuals of a fit and their derivatives, in pixels.

    Attributes:
        click: (n, 2).
        by_click: (n, 2, 12).
        drawn: (d,) perpendicular.
        by_drawn: (d, 12).
    """

    click: NDArray[np.float64]
    by_click: NDArray[np.float64]
    drawn: NDArray[np.float64]
    by_drawn: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Screened:
    """The fit to the right clicks.

    Attributes:
        row: (22,) camera.
        covariance: (12, 12) of a step, to the second order.
        tangent_covariance: (12, 12) to the first.
        evidence_information: (12, 12) of the inliers, at the estimated noise.
        inliers: (n,) bool.
        markings: (m,) bool, drawn markings that the camera rests on.
        surprise: (n,) residual in standard deviations of what the other evidence predicts.
        noise_scale: factor on the stated noise that the residuals ask for.
        misfit: mean loss of an observation in the stated noise [1]; about 1 for honest ones.
    """

    row: NDArray[np.float64]
    covariance: NDArray[np.float64]
    tangent_covariance: NDArray[np.float64]
    evidence_information: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    markings: NDArray[np.bool_]
    surprise: NDArray[np.float64]
    noise_scale: float
    misfit: float


def residual_rows(problem: Problem, row: NDArray[np.float64]) -> Rows:
    """Return all residuals of a camera (22,), with derivatives of the fixed parameters zero."""
    evidence = problem.evidence
    n, d = len(evidence.points), len(evidence.drawn_image)
    rows = Rows(np.empty((n, 2)), np.empty((n, 2, 12)), np.empty(d), np.empty((d, 12)))
    point_residuals(row, evidence.points_world, evidence.points_image, rows.click, rows.by_click)
    drawn_residuals(
        row,
        problem.reach,
        evidence.samples_world,
        evidence.bounds,
        evidence.drawn_image,
        evidence.drawn_marking,
        rows.drawn,
        rows.by_drawn,
    )
    return replace(
        rows, by_click=rows.by_click * problem.free, by_drawn=rows.by_drawn * problem.free
    )


def screen(
    problem: Problem, start: NDArray[np.float64], settings: StaticCalibrationSettings
) -> Screened:
    """Return the fit to the clicks that agree, and which those are.

    From a robust fit's inliers, one click at a time leaves or returns: the inlier whose own
    residual would grow most beyond `limit` if it were left out, else the outlier that the others
    predict. In the linear regime this is leave-one-out for every click at the price of one fit.
    A drawn marking is wrong where half of it is far off: that is another marking's name.

    Args:
        problem: what was clicked.
        start: (22,) camera near the answer.
        settings: what is wrong.

    Raises:
        InputError: only a camera that cannot be explains the clicks.
    """
    limit = settings.wrong_click
    count = len(problem.evidence.points)
    robust = adjust(problem, start[None], click_loss=_ROBUST)
    row = robust.rows[0]
    problem = problem.surveyed_from(row, settings)
    length = np.linalg.norm(residual_rows(problem, row).click, axis=1) / problem.click_noise
    inliers = length < limit * max(1.0, _spread(length))
    markings = _right_markings(problem, row, settings)
    seen = set()
    while True:
        seen.add(inliers.tobytes() + markings.tobytes())
        kept = problem.only(inliers, markings)
        fit = adjust(kept, row[None])
        row = fit.rows[0]
        covariance, scale = _covariance(kept, fit)
        rows = residual_rows(problem, row)
        surprise = _surprise(rows, covariance, scale * problem.click_noise, inliers)
        following = inliers.copy()
        wrong = np.where(inliers, surprise, 0.0)
        right = np.where(inliers, np.inf, surprise)
        if count and wrong.max() > limit:
            following[np.argmax(wrong)] = False
        elif count and right.min() < limit:
            following[np.argmin(right)] = True
        following_markings = _right_markings(problem, row, settings)
        if following.tobytes() + following_markings.tobytes() in seen:
            break
        # Half of the clicks against the other half is no majority, whoever goes next.
        if 2 * following.sum() < count:
            break
        inliers, markings = following, following_markings
    return rest_on(problem, row, inliers, markings)


def rest_on(
    problem: Problem,
    row: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    markings: NDArray[np.bool_],
) -> Screened:
    """Return the fit to some of the clicks, whatever the others say.

    Args:
        problem: what was clicked, and how well.
        row: (22,) camera near the answer.
        inliers: (n,) clicks to rest on.
        markings: (m,) drawn markings to rest on.
    """
    kept = problem.only(inliers, markings)
    fit = adjust(kept, row[None])
    row = fit.rows[0]
    covariance, scale = _covariance(kept, fit)
    surprise = _surprise(
        residual_rows(problem, row), covariance, scale * problem.click_noise, inliers
    )
    own = residual_rows(kept, row)
    evidence_rows = 2 * len(own.click) + len(own.drawn)
    squared = _click_loss(kept, own) + _drawn_loss(problem, own)
    return Screened(
        row=row,
        covariance=with_bends(kept, row, covariance, scale),
        tangent_covariance=covariance,
        evidence_information=fit.evidence_information[0] / scale**2,
        inliers=inliers,
        markings=markings,
        surprise=surprise,
        noise_scale=scale,
        misfit=float(squared / max(evidence_rows, 1)),
    )


def noise_of(problem: Problem, row: NDArray[np.float64]) -> float:
    """Return by what factor half of the clicks are farther off a camera than stated.

    Args:
        problem: what was clicked.
        row: (22,) camera.
    """
    length = np.linalg.norm(residual_rows(problem, row).click, axis=1)
    return _spread(length / problem.click_noise)


def surprise_at(problem: Problem, estimate: CameraEstimate) -> NDArray[np.float64]:
    """Return each click's residual (n,) in standard deviations of what a camera predicts.

    Args:
        problem: what was clicked.
        estimate: camera that does not rest on these clicks.
    """
    rows = residual_rows(problem, row_of(estimate.camera))
    nobody = np.zeros(len(rows.click), dtype=np.bool_)
    return _surprise(rows, estimate.covariance, problem.click_noise, nobody)


def held_out_error(problem: Problem, fit: Screened) -> float:
    """Return the root mean square error of predicting each click and marking from the rest [px].

    One click, or all pixels of one marking, are left out at a time; the residual that they would
    have then follows from the fit with them (the block form of the PRESS statistic).
    """
    evidence = problem.evidence
    rows = residual_rows(problem, fit.row)
    units = [
        (rows.click[i], rows.by_click[i], float(problem.click_noise[i]))
        for i in np.flatnonzero(fit.inliers)
    ]
    for index in np.flatnonzero(fit.markings):
        on = evidence.drawn_marking == index
        units.append((rows.drawn[on], rows.by_drawn[on], problem.drawn_noise))
    total, count = 0.0, 0
    for residual, by_step, noise in units:
        share = by_step @ fit.tangent_covariance @ by_step.T / (noise * fit.noise_scale) ** 2
        predicted = np.linalg.lstsq(np.eye(len(residual)) - share, residual, rcond=1e-9)[0]
        total += float(predicted @ predicted)
        count += len(residual)
    return float(np.sqrt(total / max(count, 1)))


def _right_markings(
    problem: Problem, row: NDArray[np.float64], settings: StaticCalibrationSettings
) -> NDArray[np.bool_]:
    """Return which drawn markings (m,) are near their projections; all where too few are."""
    off = np.abs(residual_rows(problem, row).drawn)
    count = len(problem.evidence.markings)
    on = problem.evidence.drawn_marking
    middle = np.array([np.median(off[on == index]) for index in range(count)])
    right = middle < settings.wrong_marking * problem.drawn_noise
    enough = right.sum() >= (1.0 - settings.max_wrong_share) * count
    return np.asarray(right if enough else np.ones(count, dtype=np.bool_))


def _spread(length: NDArray[np.float64]) -> float:
    # 1.1774 is the median length of a standard Gaussian in two dimensions.
    return float(np.median(length)) / 1.1774 if len(length) else 1.0


def _covariance(problem: Problem, fit: Fits) -> tuple[NDArray[np.float64], float]:
    """Return the covariance (12, 12) and the noise's scale that the residuals ask for."""
    observed = fit.evidence_information[0]
    prior = fit.information[0] - observed
    free = np.ix_(problem.free, problem.free)
    rows = residual_rows(problem, fit.rows[0])
    squared = _click_loss(problem, rows) + _drawn_loss(problem, rows)
    count = 2 * len(rows.click) + len(rows.drawn)
    spent = float(np.trace(np.linalg.solve(fit.information[0][free], observed[free])))
    squared_scale = (_OWN_WORTH + squared) / (_OWN_WORTH + max(count - spent, 0.0))
    scale = float(np.sqrt(squared_scale))
    covariance = np.zeros_like(prior)
    total = observed[free] / scale**2 + prior[free]
    # Coefficients of the lens and meters differ by many powers of ten.
    size = np.sqrt(np.abs(np.diag(total)))
    scaled = total / np.outer(size, size)
    if not np.linalg.eigvalsh(scaled)[0] > _SINGULAR:
        raise InputError(
            "clicked markings",
            expected="clicks that a camera beside or above the pitch can have made",
            found=f"{count} pixel coordinates that bring the camera down to a clicked point",
            todo="Check names and pixels of the clicks, and image_size.",
        )
    covariance[free] = np.linalg.inv(scaled) / np.outer(size, size)
    return covariance, scale


def _click_loss(problem: Problem, rows: Rows) -> float:
    return float(((rows.click / problem.click_noise[:, None]) ** 2).sum())


def _drawn_loss(problem: Problem, rows: Rows) -> float:
    limit = problem.drawn_loss**2
    return float(limit * np.log1p((rows.drawn / problem.drawn_noise) ** 2 / limit).sum())


def _surprise(
    rows: Rows,
    covariance: NDArray[np.float64],
    noise: NDArray[np.float64],
    inliers: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return each click's residual in standard deviations of its prediction without it."""
    spread = np.einsum("nij,jk,nlk->nil", rows.by_click, covariance, rows.by_click)
    # A click that the fit rests on has drawn the fit towards it.
    sign = np.where(inliers, -1.0, 1.0)[:, None, None]
    variance = noise[:, None] ** 2
    total = variance[..., None] * np.eye(2) + sign * spread
    values, vectors = np.linalg.eigh(total)
    values = np.maximum(values, 1e-6 * variance)
    along = np.einsum("nij,ni->nj", vectors, rows.click)
    return np.asarray(np.sqrt((along**2 / values).sum(axis=1)))
