"""Outliers among clicks, and the noise of the inliers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from data_contracts.arrays import Flags, Floats
from worldpose.errors import InputError
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.covariance import invert_free
from worldpose.geometry.optimize.losses import cauchy_loss
from worldpose.static_calibration.curvature_correction import add_curvature
from worldpose.static_calibration.fit import (
    CameraProblem,
    Fits,
    Residuals,
    compute_residuals,
    fit_cameras,
)
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.residuals import PRIORS, prior_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings

CLEAR_GAIN: Final = 6.0
"""Twice the logarithm of the minimum probability ratio in favor of a noise other than the stated
one [1]: twenty."""


@dataclass(frozen=True, eq=False)
class InlierFit:
    """A fit to the inliers among the clicks.

    Attributes:
        row: (WIDTH,) camera.
        covariance: (12, 12) covariance of a step, to second order.
        tangent_covariance: (12, 12) covariance of a step, to first order.
        evidence_information: (12, 12) information of the inliers, at the estimated noise.
        inliers: (n,) bool.
        markings: (m,) bool, inliers among the drawn markings.
        mahalanobis: (n,) distance of each click from its prediction by the other evidence.
        noise_scale: estimated noise over the stated noise: 1 unless residuals clearly contradict.
        click_noise: standard deviation of the inlying clicks, from their residuals [px]; NaN
            without `click_freedom`, the degrees of freedom of that estimate [1].
        misfit: mean loss per observation in the stated noise [1]; about 1 without gross errors.
    """

    row: Floats
    covariance: Floats
    tangent_covariance: Floats
    evidence_information: Floats
    inliers: Flags
    markings: Flags
    mahalanobis: Floats
    noise_scale: float
    click_noise: float
    click_freedom: float
    misfit: float

    def estimate(self, image_size: tuple[int, int]) -> CameraEstimate:
        """Return the fitted camera and its covariance."""
        return CameraEstimate(Camera.from_numbers(self.row, image_size), self.covariance)


@dataclass(frozen=True, eq=False)
class Explanation:
    """An explanation of the clicks: the noise that it assumes, and the fit at this noise.

    Attributes:
        problem: the clicks, at the noise of the explanation.
        settings: settings at this noise.
        assumptions: further assumptions, in words.
    """

    problem: CameraProblem
    fit: InlierFit
    settings: StaticCalibrationSettings
    assumptions: tuple[str, ...] = ()

    @property
    def estimate(self) -> CameraEstimate:
        """The fitted camera and its covariance."""
        return self.fit.estimate(self.problem.image_size)

    def noise_factor(self, stated: StaticCalibrationSettings) -> float:
        """Return the assumed noise over the stated noise [1]."""
        return self.settings.click_noise_px / stated.click_noise_px


def fit_inliers(
    problem: CameraProblem, start: Floats, settings: StaticCalibrationSettings
) -> InlierFit:
    """Return the fit to the inliers among clicks and markings, from a camera (WIDTH,) near it.

    From the inliers of a robust fit, the search removes or restores one click at a time: the inlier
    with the largest leave-one-out residual above the limit, else an outlier that the inliers
    predict. In the linear regime this is leave-one-out for every click at the cost of one fit. The
    noise for the test of a click comes from the other clicks: the stated noise, unless their
    residuals clearly contradict it. A click on a point that the camera cannot image is always an
    outlier. A drawn marking is an outlier if half of it has a large residual: it has the wrong
    name. InputError if only an impossible camera explains the clicks.
    """
    limit = settings.wrong_click
    count = len(problem.evidence.points)
    robust = fit_cameras(problem, start[None], click_loss=3.0)
    row = robust.rows[0]
    problem = problem.with_survey_error(row, settings)
    length = np.linalg.norm(compute_residuals(problem, row).click, axis=1) / problem.click_noise
    inliers = (length < limit * max(1.0, _median_spread(length))) & _can_image(problem, row)
    markings = _select_markings(problem, row, inliers, settings)
    seen = set()
    while True:
        seen.add(inliers.tobytes() + markings.tobytes())
        kept = problem.select(inliers, markings)
        fit = fit_cameras(kept, row[None])
        row = fit.rows[0]
        _, _, mahalanobis = _judge_clicks(problem, kept, fit, inliers)
        following = inliers.copy()
        wrong = np.where(inliers, mahalanobis, 0.0)
        right = np.where(inliers, np.inf, mahalanobis)
        if count and wrong.max() > limit:
            following[np.argmax(wrong)] = False
        elif count and right.min() < limit:
            following[np.argmin(right)] = True
        following_markings = _select_markings(problem, row, following, settings)
        if following.tobytes() + following_markings.tobytes() in seen:
            break
        # With half of the clicks as outliers, the inliers are no majority.
        if 2 * following.sum() < count:
            break
        inliers, markings = following, following_markings
    return fit_given_inliers(problem, row, inliers, markings)


def fit_inliers_at_best_noise(
    problem: CameraProblem, start: Floats, settings: StaticCalibrationSettings
) -> Explanation:
    """Return the explanation of the clicks at their most probable noise, from a camera (WIDTH,).

    A few clicks with large residuals are outliers at the stated noise, or inliers at a larger
    noise. The larger posterior probability decides: inliers are Gaussian, outliers are uniform in
    the image, and the prior of the noise is centered on the stated noise, which stands unless
    another noise is clearly more probable. InputError as of `fit_inliers`.
    """
    fit = fit_inliers(problem, start, settings)
    best = Explanation(problem.with_survey_error(fit.row, settings), fit, settings)
    if fit.inliers.all() and fit.noise_scale <= 1.0:
        return best
    lowest = negative_log_posterior(best, factor=1.0, with_prior=False)
    # The last one is the largest plausible one.
    for factor in (1.5, 2.0, 3.0, 4.0):
        other, rough = scale_noise(problem, factor, settings)
        try:
            tried = fit_inliers(other, fit.row, rough)
        except InputError:
            continue
        found = Explanation(other.with_survey_error(tried.row, rough), tried, rough)
        own = negative_log_posterior(found, factor=factor, with_prior=False)
        if own < lowest - (CLEAR_GAIN if best.settings is settings else 0.0):
            best, lowest = found, own
    return best


def scale_noise(
    problem: CameraProblem, factor: float, settings: StaticCalibrationSettings
) -> tuple[CameraProblem, StaticCalibrationSettings]:
    """Return problem and settings with the noise of clicks and drawn pixels times a factor."""
    noisy = {
        name: factor * getattr(settings, name) for name in ("click_noise_px", "drawn_noise_px")
    }
    return (
        replace(
            problem,
            click_noise=factor * problem.click_noise,
            drawn_noise=factor * problem.drawn_noise,
        ),
        settings.model_copy(update=noisy),
    )


def negative_log_posterior(
    found: Explanation, *, factor: float, with_prior: bool, noise_scale: float | None = None
) -> float:
    """Return minus twice the log posterior of an explanation, up to a constant.

    Comparisons of assumptions about the camera include the camera prior; in comparisons of noise it
    would count a lens that is rare under the prior as noise. `factor` is the noise over the stated
    one; `noise_scale` None is that of the fit.
    """
    log_two_pi = float(np.log(2.0 * np.pi))
    problem, fit, settings = found.problem, found.fit, found.settings
    kept = problem.select(fit.inliers, fit.markings)
    rows = compute_residuals(kept, fit.row)
    scale = fit.noise_scale if noise_scale is None else noise_scale
    squared = (_click_loss(kept, rows) + _drawn_loss(kept, rows)) / scale**2
    volume = 2.0 * float(np.log(scale)) * (2 * len(kept.click_noise) + len(kept.drawn_noise))
    volume += 4.0 * float(np.log(kept.click_noise).sum()) + 2.0 * len(kept.click_noise) * log_two_pi
    volume += 2.0 * float(np.log(kept.drawn_noise).sum()) + len(kept.drawn_noise) * log_two_pi
    image_volume = 2.0 * np.log(float(np.prod(problem.image_size)))
    inlier_odds = 2.0 * np.log((1.0 - settings.wrong_rate) / settings.wrong_rate)
    outliers = float((~fit.inliers).sum()) * (image_volume + inlier_odds)
    outlying_pixels = float((~fit.markings[problem.evidence.drawn_marking]).sum())
    outliers += outlying_pixels * np.log(float(np.hypot(*problem.image_size)))
    free = np.ix_(problem.free, problem.free)
    posterior_volume = -float(np.linalg.slogdet(fit.tangent_covariance[free])[1])
    if with_prior:
        posterior_volume += 4.0 * float(np.log(problem.prior[4]))  # of the principal point's prior
        known = np.empty(PRIORS)
        prior_residuals(fit.row, problem.prior, known, np.empty((PRIORS, STEP)))
        squared += float((known**2).sum())
    # True noise is half to twice the stated noise.
    noise_deviation = float(np.log(scale * factor)) / 0.5
    return float(squared + volume + outliers + posterior_volume + noise_deviation**2)


def fit_given_inliers(
    problem: CameraProblem, row: Floats, inliers: Flags, markings: Flags
) -> InlierFit:
    """Return the fit to given clicks (n,) and markings (m,), from a camera (WIDTH,) near it."""
    kept = problem.select(inliers, markings)
    fit = fit_cameras(kept, row[None])
    row = fit.rows[0]
    covariance, noise, mahalanobis = _judge_clicks(problem, kept, fit, inliers)
    scale = noise.scale
    own = compute_residuals(kept, row)
    evidence_rows = 2 * len(own.click) + len(own.drawn)
    share = noise.freedom / max(evidence_rows, 1)
    click_freedom = share * 2 * len(own.click)
    click_squared = float((own.click**2).sum())
    return InlierFit(
        row=row,
        covariance=add_curvature(kept, row, covariance, scale),
        tangent_covariance=covariance,
        evidence_information=fit.evidence_information[0] / scale**2,
        inliers=inliers,
        markings=markings,
        mahalanobis=mahalanobis,
        noise_scale=scale,
        click_noise=float(np.sqrt(click_squared / click_freedom)) if click_freedom else np.nan,
        click_freedom=click_freedom,
        misfit=float(noise.squared / max(evidence_rows, 1)),
    )


def noise_ratio(problem: CameraProblem, row: Floats) -> float:
    """Return the median click residual at a camera (WIDTH,), over its stated value."""
    length = np.linalg.norm(compute_residuals(problem, row).click, axis=1)
    return _median_spread(length / problem.click_noise)


def mahalanobis_distances(problem: CameraProblem, estimate: CameraEstimate) -> Floats:
    """Return each click's distance (n,) from its prediction by an independent camera."""
    rows = compute_residuals(problem, estimate.camera.numbers)
    no_inliers = np.zeros(len(rows.click), dtype=np.bool_)
    return _leave_one_out_distances(rows, estimate.covariance, problem.click_noise, no_inliers)


def held_out_error(problem: CameraProblem, fit: InlierFit) -> float:
    """Return the root mean square leave-one-out error of clicks and markings [px].

    One click, or all pixels of one marking, are left out at a time; their residual follows from the
    complete fit (the block form of the PRESS statistic).
    """
    evidence = problem.evidence
    rows = compute_residuals(problem, fit.row)
    units = [
        (rows.click[i], rows.by_click[i], problem.click_noise[i : i + 1])
        for i in np.flatnonzero(fit.inliers)
    ]
    for index in np.flatnonzero(fit.markings):
        on = evidence.drawn_marking == index
        units.append((rows.drawn[on], rows.by_drawn[on], problem.drawn_noise[on]))
    total, count = 0.0, 0
    root = covariance_root(fit.tangent_covariance)
    for residual, by_step, noise in units:
        # A marking has thousands of pixels, but their hat matrix has rank 12.
        sigma = np.broadcast_to(noise * fit.noise_scale, len(residual))
        shared = by_step @ root / sigma[:, None]
        leverage, along = np.linalg.eigh(shared.T @ shared)
        is_predicted = np.abs(1.0 - leverage) > 1e-9
        # The rest does not predict directions that only this unit observes: no error counts there.
        gain = np.where(is_predicted, 1.0, -1.0) / np.where(is_predicted, 1.0 - leverage, leverage)
        whitened = residual / sigma
        predicted = sigma * (whitened + shared @ (along @ (gain * (along.T @ shared.T @ whitened))))
        total += float(predicted @ predicted)
        count += len(residual)
    return float(np.sqrt(total / max(count, 1)))


def covariance_root(covariance: Floats) -> Floats:
    """Return R (12, 12) with R R^T = covariance (12, 12), also where rounding makes it indefinite.

    Coefficients of the lens and meters differ by many powers of ten.
    """
    size = np.sqrt(np.diag(covariance))
    size[size == 0.0] = 1.0  # parameters that may not move
    values, axes = np.linalg.eigh(covariance / np.outer(size, size))
    return np.asarray(size[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))


def _select_markings(
    problem: CameraProblem, row: Floats, inliers: Flags, settings: StaticCalibrationSettings
) -> Flags:
    """Return a mask of drawn markings (m,) near their projections; all where too few remain.

    The mask rejects markings only if the remaining clicks and markings hold most of all
    constraints, and enough to determine the camera.
    """
    evidence = problem.evidence
    away = np.abs(compute_residuals(problem, row).drawn)
    marking = evidence.drawn_marking
    # A marking that `select` left without pixels is not near anything.
    medians = np.array(
        [
            np.median(away[marking == index]) if index in marking else np.inf
            for index in range(len(evidence.markings))
        ]
    )
    accepted = np.asarray(medians < settings.wrong_marking * settings.drawn_noise_px)
    every = np.ones_like(inliers), np.ones_like(accepted)
    all_constraints = evidence.count_constraints(*every)
    remaining = evidence.count_constraints(inliers, accepted)
    share = 1.0 - settings.max_wrong_share
    few = accepted.sum() < share * len(accepted) and remaining < 8
    enough = remaining >= share * all_constraints and not few
    return accepted if enough else np.ones(len(accepted), dtype=np.bool_)


def _can_image(problem: CameraProblem, row: Floats) -> Flags:
    """Return a mask of the clicked points (n,) that a camera (WIDTH,) can image."""
    camera = Camera.from_numbers(row, problem.image_size)
    return np.asarray(np.isfinite(camera.project(problem.evidence.points_world)).all(axis=-1))


def _median_spread(length: Floats) -> float:
    # 1.1774 is the median length of a standard Gaussian in two dimensions.
    return float(np.median(length)) / 1.1774 if len(length) else 1.0


@dataclass(frozen=True)
class _Noise:
    """Noise of a fit, estimated from its residuals.

    Attributes:
        scale: estimated noise over the stated noise.
        worth: degrees of freedom of the scale; infinite for the stated noise.
        squared: sum of squared residuals in the stated noise, with `freedom` degrees of freedom.
    """

    scale: float
    worth: float
    squared: float
    freedom: float

    @classmethod
    def estimate(cls, squared: float, freedom: float) -> _Noise:
        """Return the stated noise, unless the residuals clearly contradict it."""
        prior = 4.0  # degrees of freedom of the stated noise: correct within a factor of 1.4
        significance = 0.002  # of the test that residuals contradict the stated noise
        stated = cls(1.0, np.inf, squared, freedom)
        if freedom < 1.0:
            return stated
        low, high = chdtri(freedom, [1.0 - 0.5 * significance, 0.5 * significance])
        if low <= squared <= high:
            return stated
        worth = prior + freedom
        scale = np.sqrt((prior + squared) / (worth - 2.0))
        # Beyond five times the stated noise, names are wrong.
        return cls(min(float(scale), 5.0), worth, squared, freedom)


def _judge_clicks(
    problem: CameraProblem, kept: CameraProblem, fit: Fits, inliers: Flags
) -> tuple[Floats, _Noise, Floats]:
    """Return the covariance (12, 12), the noise, and each click's Mahalanobis distance (n,).

    Distances are as for a Gaussian: if the noise is only an estimate, the distance shrinks
    (Student's t-distribution in two dimensions).
    """
    covariance, noise = _covariance(kept, fit)
    row = fit.rows[0]
    rows = compute_residuals(problem, row)
    length = _leave_one_out_distances(rows, covariance, noise.scale * problem.click_noise, inliers)
    mahalanobis = np.empty(len(length))
    for index, own in enumerate(length):
        others = noise
        if inliers[index]:
            left = max(noise.squared - (own * noise.scale) ** 2, 0.0)
            others = _Noise.estimate(left, noise.freedom - 2.0)
        # Drawn pixels that are more accurate than stated do not make clicks more accurate.
        scale = max(others.scale, 1.0)
        mahalanobis[index] = own * noise.scale / scale
        if others.worth < np.inf:  # the distance of the same tail probability for a 2D Gaussian
            squared, worth = mahalanobis[index] ** 2, others.worth
            mahalanobis[index] = np.sqrt(worth * np.log1p(squared / worth))
    mahalanobis[~_can_image(problem, row)] = np.inf
    return covariance, noise, mahalanobis


def _covariance(problem: CameraProblem, fit: Fits) -> tuple[Floats, _Noise]:
    """Return the covariance (12, 12), and the noise estimated from the residuals."""
    observed = fit.evidence_information[0]
    prior = fit.information[0] - observed
    free = np.ix_(problem.free, problem.free)
    rows = compute_residuals(problem, fit.rows[0])
    squared = _click_loss(problem, rows) + _drawn_loss(problem, rows)
    count = 2 * len(rows.click) + len(rows.drawn)
    if not _is_invertible(fit.information[0][free]):
        raise _no_camera(problem, count)
    spent = float(np.trace(np.linalg.solve(fit.information[0][free], observed[free])))
    noise = _Noise.estimate(squared, max(count - spent, 0.0))
    total = observed / noise.scale**2 + prior
    if not _is_invertible(total[free]):
        raise _no_camera(problem, count)
    return invert_free(total, problem.free), noise


def _is_invertible(information: Floats) -> bool:
    """Return whether an information matrix is invertible after scaling of its parameters.

    Coefficients of the lens and meters differ by many powers of ten.
    """
    size = np.sqrt(np.abs(np.diag(information)))
    if not (np.isfinite(information).all() and size.all()):
        return False
    # Below, a point lies in the camera's center, and rounding decides.
    return bool(np.linalg.eigvalsh(information / np.outer(size, size))[0] > 1e-14)


def _no_camera(problem: CameraProblem, count: int) -> InputError:
    return InputError(
        problem.where,
        expected="clicks that a camera next to or above the pitch can see",
        found=f"{count} pixel coordinates that bring the camera down to a clicked point",
        todo="Check names and pixels of the clicks, and image_size.",
    )


def _click_loss(problem: CameraProblem, rows: Residuals) -> float:
    return float(((rows.click / problem.click_noise[:, None]) ** 2).sum())


def _drawn_loss(problem: CameraProblem, rows: Residuals) -> float:
    squared = (rows.drawn / problem.drawn_noise) ** 2
    return float(cauchy_loss(squared, problem.drawn_loss).sum())


def _leave_one_out_distances(
    rows: Residuals, covariance: Floats, noise: Floats, inliers: Flags
) -> Floats:
    """Return each click's Mahalanobis distance from its prediction by the other clicks."""
    spread = np.einsum("nij,jk,nlk->nil", rows.by_click, covariance, rows.by_click)
    # An inlier has moved the fit towards itself.
    sign = np.where(inliers, -1.0, 1.0)[:, None, None]
    variance = noise[:, None] ** 2
    total = variance[..., None] * np.eye(2) + sign * spread
    values, vectors = np.linalg.eigh(total)
    values = np.maximum(values, 1e-6 * variance)
    along = np.einsum("nij,ni->nj", vectors, rows.click)
    return np.asarray(np.sqrt((along**2 / values).sum(axis=1)))
