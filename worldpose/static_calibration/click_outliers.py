"""Which clicks are wrong, and how large the noise of the others is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from worldpose.errors import InputError
from worldpose.static_calibration.adjustment import (
    Fits,
    Problem,
    adjust,
    camera_of_row,
    row_of,
)
from worldpose.static_calibration.curvature_correction import with_bends
from worldpose.static_calibration.parameters import CameraEstimate
from worldpose.static_calibration.residuals import (
    PRIORS,
    SIZE,
    drawn_residuals,
    point_residuals,
    prior_residuals,
)
from worldpose.static_calibration.settings import StaticCalibrationSettings

_ROBUST: Final = 3.0
"""Cauchy scale of clicks [standard deviations] of the fit that the screening starts from."""
_SINGULAR: Final = 1e-14
"""Least eigenvalue of the scaled information [1]: below it a point lies in the camera's center,
and rounding decides."""
_CLEARLY: Final = 0.002
"""Probability that honest residuals of the stated noise say by chance that it is another [1]."""
_STATED_FREEDOM: Final = 4.0
"""Degrees of freedom that the stated noise is worth where residuals say that it is another [1]: a
statement within a factor of 1.4."""
_LARGEST_SCALE: Final = 5.0
"""Largest factor on the stated noise that is believed [1]; beyond, names are wrong."""
_NOISES: Final = (1.5, 2.0, 3.0, 4.0)
"""Factors on the stated noise that are tried where the stated one does not explain the clicks [1];
none is believed to be worse than the last."""
CLEAR_GAIN: Final = 6.0
"""Twice the logarithm of how much more probable another noise than the stated one must be [1]:
twenty times."""
_NOISE_SPREAD: Final = 0.5
"""Of the logarithm of this factor [1]: people click half to twice as well as they say."""
_TWO_PI: Final = float(np.log(2.0 * np.pi))
_POINT_NUMBERS: Final = 2
_LINE_NUMBERS: Final = 2
_ARC_NUMBERS: Final = 4
"""Numbers that a click, a straight marking and an arc tell, however long they are drawn [1]."""
_ALONE: Final = 1e-9
"""One minus the leverage of a click or marking below which only it observes a parameter [1]."""
_ENOUGH_NUMBERS: Final = 8
"""Numbers that must be left for a marking to be taken for wrong [1]: four clicks."""


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
        noise_scale: factor on the stated noise that is taken: 1 unless the residuals clearly say
            another.
        click_noise: standard deviation of the inlying clicks that their residuals say [px]; NaN
            without degrees of freedom.
        click_freedom: degrees of freedom that it rests on [1].
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
    click_noise: float
    click_freedom: float
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
    The noise that a click is judged by is that of the others: the stated one, unless their
    residuals clearly say another. A click on a point that the camera cannot image never stays.
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
    inliers = (length < limit * max(1.0, _spread(length))) & _imaged(problem, row)
    markings = _right_markings(problem, row, inliers, settings)
    seen = set()
    while True:
        seen.add(inliers.tobytes() + markings.tobytes())
        kept = problem.only(inliers, markings)
        fit = adjust(kept, row[None])
        row = fit.rows[0]
        _, _, surprise = _judged_clicks(problem, kept, fit, inliers)
        following = inliers.copy()
        wrong = np.where(inliers, surprise, 0.0)
        right = np.where(inliers, np.inf, surprise)
        if count and wrong.max() > limit:
            following[np.argmax(wrong)] = False
        elif count and right.min() < limit:
            following[np.argmin(right)] = True
        following_markings = _right_markings(problem, row, following, settings)
        if following.tobytes() + following_markings.tobytes() in seen:
            break
        # Half of the clicks against the other half is no majority, whoever goes next.
        if 2 * following.sum() < count:
            break
        inliers, markings = following, following_markings
    return rest_on(problem, row, inliers, markings)


def screen_at_best_noise(
    problem: Problem, start: NDArray[np.float64], settings: StaticCalibrationSettings
) -> tuple[Problem, Screened, StaticCalibrationSettings]:
    """Return problem, fit and settings at the noise of clicks that explains them best.

    A few clicks far off are wrong ones at the stated noise, or honest ones at a larger noise. The
    explanation with the larger posterior probability is taken: inliers are Gaussian, a wrong click
    is anywhere in the image, and the noise is near the stated one, which stands unless another is
    clearly more probable.

    Args:
        problem: what was clicked.
        start: (22,) camera near the answer.
        settings: the stated noise, and what is wrong.

    Raises:
        InputError: only a camera that cannot be explains the clicks.
    """
    fit = screen(problem, start, settings)
    best = problem.surveyed_from(fit.row, settings), fit, settings
    if fit.inliers.all() and fit.noise_scale <= 1.0:
        return best
    least = improbability(*best, factor=1.0, with_prior=False)
    for factor in _NOISES:
        other, rough = at_noise(problem, factor, settings)
        try:
            tried = screen(other, fit.row, rough)
        except InputError:
            continue
        found = other.surveyed_from(tried.row, rough), tried, rough
        own = improbability(*found, factor=factor, with_prior=False)
        if own < least - (CLEAR_GAIN if best[2] is settings else 0.0):
            best, least = found, own
    return best


def at_noise(
    problem: Problem, factor: float, settings: StaticCalibrationSettings
) -> tuple[Problem, StaticCalibrationSettings]:
    """Return problem and settings with so many times the noise of clicks and drawn pixels."""
    noisy = {name: factor * getattr(settings, name) for name in ("click_noise", "drawn_noise")}
    return (
        replace(
            problem,
            click_noise=factor * problem.click_noise,
            drawn_noise=factor * problem.drawn_noise,
        ),
        settings.model_copy(update=noisy),
    )


def improbability(
    problem: Problem,
    fit: Screened,
    settings: StaticCalibrationSettings,
    *,
    factor: float,
    with_prior: bool,
) -> float:
    """Return minus twice the logarithm of an explanation's posterior, but for a constant.

    Args:
        problem: what was clicked, at the noise of the explanation.
        fit: to it.
        settings: at this noise.
        factor: on the stated noise.
        with_prior: count how plausible the camera is: to compare other assumptions about it. Of
            two noises it tells nothing, and a lens that the prior does not know would be taken
            for noise.
    """
    kept = problem.only(fit.inliers, fit.markings)
    rows = residual_rows(kept, fit.row)
    scale = fit.noise_scale
    squared = (_click_loss(kept, rows) + _drawn_loss(kept, rows)) / scale**2
    volume = 2.0 * float(np.log(scale)) * (2 * len(kept.click_noise) + len(kept.drawn_noise))
    volume += 4.0 * float(np.log(kept.click_noise).sum()) + 2.0 * len(kept.click_noise) * _TWO_PI
    volume += 2.0 * float(np.log(kept.drawn_noise).sum()) + len(kept.drawn_noise) * _TWO_PI
    anywhere = 2.0 * np.log(float(np.prod(problem.image_size)))
    honest = 2.0 * np.log((1.0 - settings.wrong_rate) / settings.wrong_rate)
    wrong = float((~fit.inliers).sum()) * (anywhere + honest)
    lost = float((~fit.markings[problem.evidence.drawn_marking]).sum())
    wrong += lost * np.log(float(np.hypot(*problem.image_size)))
    free = np.ix_(problem.free, problem.free)
    told = -float(np.linalg.slogdet(fit.tangent_covariance[free])[1])
    if with_prior:
        told += 4.0 * float(np.log(problem.prior[4]))  # of the principal point's prior
        known = np.empty(PRIORS)
        prior_residuals(fit.row, problem.prior, known, np.empty((PRIORS, SIZE)))
        squared += float((known**2).sum())
    far = float(np.log(scale * factor)) / _NOISE_SPREAD
    return float(squared + volume + wrong + told + far**2)


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
    covariance, noise, surprise = _judged_clicks(problem, kept, fit, inliers)
    scale = noise.scale
    own = residual_rows(kept, row)
    evidence_rows = 2 * len(own.click) + len(own.drawn)
    share = noise.freedom / max(evidence_rows, 1)
    click_freedom = share * 2 * len(own.click)
    click_squared = float((own.click**2).sum())
    return Screened(
        row=row,
        covariance=with_bends(kept, row, covariance, scale),
        tangent_covariance=covariance,
        evidence_information=fit.evidence_information[0] / scale**2,
        inliers=inliers,
        markings=markings,
        surprise=surprise,
        noise_scale=scale,
        click_noise=float(np.sqrt(click_squared / click_freedom)) if click_freedom else np.nan,
        click_freedom=click_freedom,
        misfit=float(noise.squared / max(evidence_rows, 1)),
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
        (rows.click[i], rows.by_click[i], problem.click_noise[i : i + 1])
        for i in np.flatnonzero(fit.inliers)
    ]
    for index in np.flatnonzero(fit.markings):
        on = evidence.drawn_marking == index
        units.append((rows.drawn[on], rows.by_drawn[on], problem.drawn_noise[on]))
    total, count = 0.0, 0
    size = np.sqrt(np.diag(fit.tangent_covariance))
    size[size == 0.0] = 1.0  # parameters that may not move
    values, axes = np.linalg.eigh(fit.tangent_covariance / np.outer(size, size))
    root = size[:, None] * axes * np.sqrt(np.maximum(values, 0.0))
    for residual, by_step, noise in units:
        # A marking has thousands of pixels, but what they share with the fit has rank 12.
        sigma = np.broadcast_to(noise * fit.noise_scale, len(residual))
        shared = by_step @ root / sigma[:, None]
        leverage, along = np.linalg.eigh(shared.T @ shared)
        is_predicted = np.abs(1.0 - leverage) > _ALONE
        # What only this unit observes, the rest does not predict: no error counts there.
        gain = np.where(is_predicted, 1.0, -1.0) / np.where(is_predicted, 1.0 - leverage, leverage)
        whitened = residual / sigma
        predicted = sigma * (whitened + shared @ (along @ (gain * (along.T @ shared.T @ whitened))))
        total += float(predicted @ predicted)
        count += len(residual)
    return float(np.sqrt(total / max(count, 1)))


def _right_markings(
    problem: Problem,
    row: NDArray[np.float64],
    inliers: NDArray[np.bool_],
    settings: StaticCalibrationSettings,
) -> NDArray[np.bool_]:
    """Return which drawn markings (m,) are near their projections; all where too little is left.

    Clicks and markings are one electorate: markings are wrong where what stays, clicks included,
    tells most of all numbers, and enough of them for a camera.
    """
    evidence = problem.evidence
    off = np.abs(residual_rows(problem, row).drawn)
    on = evidence.drawn_marking
    middle = np.array([np.median(off[on == index]) for index in range(len(evidence.markings))])
    right = np.asarray(middle < settings.wrong_marking * settings.drawn_noise)
    numbers = np.where(evidence.straight, _LINE_NUMBERS, _ARC_NUMBERS)
    all_numbers = _POINT_NUMBERS * len(inliers) + int(numbers.sum())
    left = _POINT_NUMBERS * int(inliers.sum()) + int(numbers[right].sum())
    share = 1.0 - settings.max_wrong_share
    few = right.sum() < share * len(right) and left < _ENOUGH_NUMBERS
    enough = left >= share * all_numbers and not few
    return right if enough else np.ones(len(right), dtype=np.bool_)


def _imaged(problem: Problem, row: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which clicked points (n,) a camera (22,) can image."""
    camera = camera_of_row(row, problem.image_size)
    return np.asarray(np.isfinite(camera.project(problem.evidence.points_world)).all(axis=-1))


def _spread(length: NDArray[np.float64]) -> float:
    # 1.1774 is the median length of a standard Gaussian in two dimensions.
    return float(np.median(length)) / 1.1774 if len(length) else 1.0


@dataclass(frozen=True)
class _Noise:
    """How far the residuals of a fit are off.

    Attributes:
        scale: factor on the stated noise that is taken.
        worth: degrees of freedom that the scale rests on; infinite for the stated noise.
        squared: sum of squared residuals in the stated noise.
        freedom: degrees of freedom of that sum.
    """

    scale: float
    worth: float
    squared: float
    freedom: float

    @classmethod
    def told(cls, squared: float, freedom: float) -> _Noise:
        """The stated noise, unless the residuals clearly say another."""
        stated = cls(1.0, np.inf, squared, freedom)
        if freedom < 1.0:
            return stated
        low, high = chdtri(freedom, [1.0 - 0.5 * _CLEARLY, 0.5 * _CLEARLY])
        if low <= squared <= high:
            return stated
        worth = _STATED_FREEDOM + freedom
        scale = np.sqrt((_STATED_FREEDOM + squared) / (worth - 2.0))
        return cls(min(float(scale), _LARGEST_SCALE), worth, squared, freedom)


def _judged_clicks(
    problem: Problem, kept: Problem, fit: Fits, inliers: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], _Noise, NDArray[np.float64]]:
    """Return the covariance (12, 12), the noise, and each click's surprise (n,).

    Surprise is in standard deviations of a Gaussian: that of a click of which the noise is only
    estimated is less than its distance (Student's law in two dimensions).

    Args:
        problem: what was clicked.
        kept: that of it which the fit rests on.
        fit: a single one.
        inliers: (n,) which clicks it rests on.
    """
    covariance, noise = _covariance(kept, fit)
    row = fit.rows[0]
    rows = residual_rows(problem, row)
    length = _surprise(rows, covariance, noise.scale * problem.click_noise, inliers)
    surprise = np.empty(len(length))
    for index, own in enumerate(length):
        others = noise
        if inliers[index]:
            left = max(noise.squared - (own * noise.scale) ** 2, 0.0)
            others = _Noise.told(left, noise.freedom - 2.0)
        # Drawn pixels that are nearer than stated do not make clicks nearer.
        scale = max(others.scale, 1.0)
        surprise[index] = _as_gaussian(own * noise.scale / scale, others.worth)
    surprise[~_imaged(problem, row)] = np.inf
    return covariance, noise, surprise


def _as_gaussian(distance: float, worth: float) -> float:
    """Return the distance of a Gaussian in two dimensions that is exceeded as often."""
    if not worth < np.inf:
        return distance
    return float(np.sqrt(worth * np.log1p(distance**2 / worth)))


def _covariance(problem: Problem, fit: Fits) -> tuple[NDArray[np.float64], _Noise]:
    """Return the covariance (12, 12), and the noise that the residuals say."""
    observed = fit.evidence_information[0]
    prior = fit.information[0] - observed
    free = np.ix_(problem.free, problem.free)
    rows = residual_rows(problem, fit.rows[0])
    squared = _click_loss(problem, rows) + _drawn_loss(problem, rows)
    count = 2 * len(rows.click) + len(rows.drawn)
    if not _is_invertible(fit.information[0][free]):
        raise _no_camera(problem, count)
    spent = float(np.trace(np.linalg.solve(fit.information[0][free], observed[free])))
    noise = _Noise.told(squared, max(count - spent, 0.0))
    covariance = np.zeros_like(prior)
    total = observed[free] / noise.scale**2 + prior[free]
    size = np.sqrt(np.abs(np.diag(total)))
    scaled = total / np.outer(size, size)
    if not _is_invertible(total):
        raise _no_camera(problem, count)
    covariance[free] = np.linalg.inv(scaled) / np.outer(size, size)
    return covariance, noise


def _is_invertible(information: NDArray[np.float64]) -> bool:
    """Whether an information can be inverted, each parameter in its own unit.

    Coefficients of the lens and meters differ by many powers of ten.
    """
    size = np.sqrt(np.abs(np.diag(information)))
    if not (np.isfinite(information).all() and size.all()):
        return False
    return bool(np.linalg.eigvalsh(information / np.outer(size, size))[0] > _SINGULAR)


def _no_camera(problem: Problem, count: int) -> InputError:
    return InputError(
        problem.where,
        expected="clicks that a camera beside or above the pitch can have made",
        found=f"{count} pixel coordinates that bring the camera down to a clicked point",
        todo="Check names and pixels of the clicks, and image_size.",
    )


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
