"""Calibration of one static camera from clicks in its image (C1-C5)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.static_calibration import ClickedMarkings
from worldpose.errors import InputError
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.adjustment import (
    Problem,
    adjust,
    camera_of_row,
    problem_of,
)
from worldpose.static_calibration.agreement import refine_and_judge
from worldpose.static_calibration.checks import (
    check_agreement,
    check_amount,
    check_determined,
    check_mirrored,
    check_unit,
    has_enough_points,
    is_suspicious,
)
from worldpose.static_calibration.click_outliers import (
    CLEAR_GAIN,
    Screened,
    at_noise,
    held_out_error,
    improbability,
    screen,
    screen_at_best_noise,
)
from worldpose.static_calibration.evidence import gather
from worldpose.static_calibration.initialization import from_homographies, plausible_cameras
from worldpose.static_calibration.parameters import PARAMETERS, CameraEstimate
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.reporting import report_of
from worldpose.static_calibration.settings import StaticCalibrationSettings

_COARSE: Final = 60.0
"""Cauchy scale of all residuals while starts compete [standard deviations]: it bounds the influence
of residuals of hundreds of pixels, but not of tens."""
_CLOSE: Final = 4.0
"""Mean loss per observation [1] above which the search over plausible cameras replaces the camera
of a homography."""
_STEPS: Final = 12
"""Iterations per start before the best start is chosen [1]."""
_CROPPED: Final = 0.15
"""Spread of a cropped image's principal point, in widths [1]: covers crops of half the size."""
_FARTHEST_CROP: Final = 0.5
"""Largest offset of a cropped image's principal point from its center, in widths and in heights
[1]: a corner of an image of twice its size."""
_FOR_CROP: Final = 7
"""Minimum clicked points, or markings, that distinguish a crop from wrong names [1]."""
_MOST_LEFT_OUT: Final = 16
"""Maximum clicks for leave-one-out starts [1]."""
_OTHER_STARTS: Final = 2
"""Leave-one-out starts to refine, the best first [1]."""
_FOR_K3: Final = 24
"""Minimum residuals to try k3 [1]: twice the parameters."""


def calibrate(
    pitch: PitchTemplate,
    clicked: ClickedMarkings,
    image_size: tuple[int, int],
    *,
    picture: NDArray[np.uint8] | None = None,
    settings: StaticCalibrationSettings = StaticCalibrationSettings(),  # noqa: B008
    where: str = "clicked markings",
) -> StaticCalibration:
    """Return the camera of an image, its covariance and its report.

    Stage 1 finds starts: homographies of the flattened pitch, or plausible cameras where clicks
    are too few for one. Stage 2 fits pose, focal length, principal point and distortion on the
    crowned pitch, and excludes outliers among the clicks. Stage 3 refines on the painted lines of
    the image, if there is one.

    Args:
        pitch: the stadium's template.
        clicked: named points, and pixels along named markings.
        image_size: width, height [px].
        picture: (height, width) or (height, width, 3); without it there is no stage 3.
        settings: noise, prior and thresholds.
        where: file or camera, for messages.

    Raises:
        InputError: a name is unknown, a pixel lies outside the image, names are mirrored, the
            clicks contradict each other, or they do not determine the camera; the message says
            which clicks to add.

    Note:
        C1-C5; paper section "Static Camera Calibration".
    """
    evidence = gather(pitch, clicked, image_size, settings.sample_spacing, where)
    check_amount(evidence, pitch, where)
    problem = problem_of(evidence, image_size, settings, where=where)
    stated = settings
    problem, fit, settings = screen_at_best_noise(problem, _start(problem, settings), settings)
    problem, fit, settings, excuses = _agreed(problem, fit, pitch, settings, stated)
    check_determined(problem, fit, pitch, settings, where)
    problem, fit, decisions = _with_k3(problem, fit, settings)
    decisions = (*excuses, *decisions)
    estimate = CameraEstimate(camera_of_row(fit.row, image_size), fit.covariance)
    lines = None
    if picture is not None and settings.lines:
        fit, lines = refine_and_judge(problem, fit, pitch, picture, settings)
        estimate = lines.estimate
    report = report_of(
        estimate, problem, fit, decisions, lines, pitch, settings, stated.click_noise
    )
    return StaticCalibration(estimate, report)


def _agreed(
    problem: Problem,
    fit: Screened,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
    stated: StaticCalibrationSettings,
) -> tuple[Problem, Screened, StaticCalibrationSettings, tuple[str, ...]]:
    """Return problem, fit and settings of consistent clicks, and the assumptions behind them.

    Before many clicks count as outliers, or as far noisier than stated, the search tries other
    explanations: drawn markings are wrong, or the image is a crop, so that the principal point
    lies elsewhere.

    Args:
        problem: the clicks, at the most probable noise.
        fit: fit to them.
        pitch: the template.
        settings: settings at that noise.
        stated: settings as given.

    Raises:
        InputError: the names are mirrored, the pitch has another size or unit, or no camera
            explains most of the clicks.
    """
    factor = settings.click_noise / stated.click_noise
    as_stated = at_noise(problem, 1.0 / factor, settings)[0]
    if not is_suspicious(fit, factor):
        if not fit.inliers.all() or factor * fit.noise_scale > 1.0:
            check_unit(as_stated, (problem, fit, settings), pitch, stated)
        return problem, fit, settings, ()
    check_mirrored(problem, fit, settings)
    least = improbability(problem, fit, settings, factor=factor, with_prior=True) - CLEAR_GAIN
    best: tuple[Problem, Screened, StaticCalibrationSettings, tuple[str, ...]]
    best = problem, fit, settings, ()
    for row in _other_starts(as_stated, stated):
        try:
            found = screen_at_best_noise(as_stated, row, stated)
        except InputError:
            continue
        other_factor = found[2].click_noise / stated.click_noise
        own = improbability(*found, factor=other_factor, with_prior=True)
        if own < least + CLEAR_GAIN:
            least, best = own - CLEAR_GAIN, (*found, ())
    for other, assumed in _explanations(as_stated):
        try:
            found = screen_at_best_noise(other, _start(other, stated), stated)
        except InputError:
            continue
        shift = np.abs(found[1].row[2:4] - problem.prior[2:4])
        if np.any(shift > _FARTHEST_CROP * np.array(problem.image_size)):
            continue
        factor = found[2].click_noise / stated.click_noise
        own = improbability(*found, factor=factor, with_prior=True)
        if own < least:
            least, best = own, _explained(as_stated, other, found, factor, assumed)
    check_agreement(*best[:2], pitch, best[2], stated)
    check_unit(as_stated, best[:3], pitch, stated)
    return best


def _other_starts(
    problem: Problem, settings: StaticCalibrationSettings
) -> list[NDArray[np.float64]]:
    """Return starts (22,) that leave out one click each.

    A single click under a wrong name may hold the robust fit in another minimum.
    """
    count = len(problem.evidence.points)
    if count > _MOST_LEFT_OUT:
        return []
    every = np.ones(len(problem.evidence.markings), dtype=np.bool_)
    found = []
    for index in range(count):
        fewer = problem.only(np.arange(count) != index, every)
        rows = from_homographies(fewer, settings.prior, leave_out=False)
        if len(rows):
            found.append(_descended(fewer, rows, settings.wrong_click))
    return [row for row, _ in sorted(found, key=lambda one: one[1])[:_OTHER_STARTS]]


def _explained(
    problem: Problem,
    other: Problem,
    found: tuple[Problem, Screened, StaticCalibrationSettings],
    factor: float,
    assumed: Callable[[Screened], str],
) -> tuple[Problem, Screened, StaticCalibrationSettings, tuple[str, ...]]:
    """Return an explanation applied to the whole problem: markings that it lacks are outliers."""
    within, fit, settings = found
    said = (assumed(fit),)
    if len(other.evidence.drawn_image) == len(problem.evidence.drawn_image):
        return within, fit, settings, said
    none = np.zeros(len(problem.evidence.markings), dtype=np.bool_)
    whole = at_noise(problem, factor, settings)[0]
    return whole.surveyed_from(fit.row, settings), replace(fit, markings=none), settings, said


def _explanations(problem: Problem) -> Iterator[tuple[Problem, Callable[[Screened], str]]]:
    """Yield alternative problems, each with a function that words its assumption."""
    evidence, prior = problem.evidence, problem.prior.copy()
    prior[4] = _CROPPED * problem.image_size[0]
    middle = problem.prior[2:4]

    def shift(fit: Screened) -> str:
        x, y = fit.row[2:4] - middle
        return (
            f"the principal point lies {x:+.0f}, {y:+.0f} px off the image's center: the image "
            "seems to be cropped"
        )

    names = ", ".join(evidence.markings)
    if evidence.markings and has_enough_points(evidence):
        points = np.ones(len(evidence.points), dtype=np.bool_)
        alone = problem.only(points, np.zeros(len(evidence.markings), dtype=np.bool_))
        yield alone, lambda fit: f"{names} left out: drawn elsewhere than the points say"
    if max(len(evidence.points), len(evidence.markings)) >= _FOR_CROP:
        yield replace(problem, prior=prior), shift


def _start(problem: Problem, settings: StaticCalibrationSettings) -> NDArray[np.float64]:
    """Return the (22,) camera that the outlier search starts from."""
    count = 2 * len(problem.evidence.points) + len(problem.evidence.drawn_image)
    rows = from_homographies(problem, settings.prior, leave_out=False)
    if len(rows):
        best, cost = _descended(problem, rows, settings.wrong_click)
        if cost < 0.5 * _CLOSE * count:
            return best
    coarse = replace(problem, drawn_loss=_COARSE)
    everywhere = plausible_cameras(problem, settings.prior)
    weighed = adjust(coarse, everywhere, click_loss=_COARSE, iterations=0)
    chosen = everywhere[np.argsort(weighed.cost, kind="stable")[: settings.search_cameras]]
    rows = from_homographies(problem, settings.prior, leave_out=True)
    return _descended(problem, np.concatenate([rows, chosen]), settings.wrong_click)[0]


def _descended(
    problem: Problem, rows: NDArray[np.float64], click_loss: float
) -> tuple[NDArray[np.float64], float]:
    """Return the best camera (22,) reached from starts (b, 22), and its robust cost.

    A wide loss first moves every start into its basin; then a sharper loss decides, which a marking
    under a wrong name cannot dominate.
    """
    coarse = replace(problem, drawn_loss=_COARSE)
    near = adjust(coarse, rows, click_loss=_COARSE, iterations=_STEPS)
    sharp = adjust(problem, near.rows, click_loss=click_loss, iterations=_STEPS)
    direct = adjust(problem, rows, click_loss=click_loss, iterations=_STEPS)
    cost = np.concatenate([sharp.cost, direct.cost])
    best = int(np.argmin(cost))
    return np.concatenate([sharp.rows, direct.rows])[best], float(cost[best])


def _with_k3(
    problem: Problem, fit: Screened, settings: StaticCalibrationSettings
) -> tuple[Problem, Screened, tuple[str, ...]]:
    """Return problem and fit, with k3 if it lowers the held-out error, and the decisions (C5)."""
    before = held_out_error(problem, fit)
    decisions = [f"held-out error {before:.2f} px with {settings.distortion}"]
    count = 2 * int(fit.inliers.sum()) + len(problem.evidence.drawn_image)
    if settings.distortion != "k1_k2":
        return problem, fit, tuple(decisions)
    if count < _FOR_K3:
        decisions.append(f"k3 kept 0: {count} residuals, tried from {_FOR_K3}")
        return problem, fit, tuple(decisions)
    wider = replace(problem, free=np.arange(len(PARAMETERS)) < len(PARAMETERS))
    more = screen(wider, fit.row, settings)
    after = held_out_error(wider, more)
    same = bool((more.inliers == fit.inliers).all() and (more.markings == fit.markings).all())
    if same and after < (1.0 - settings.k3_gain) * before:
        decisions.append(f"k3 solved for: held-out error {before:.2f} to {after:.2f} px")
        return wider, more, tuple(decisions)
    decisions.append(f"k3 kept 0: held-out error {before:.2f} px without, {after:.2f} px with it")
    return problem, fit, tuple(decisions)
