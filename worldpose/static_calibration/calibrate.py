"""One static camera from what was clicked in its picture (C1-C5)."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.static_calibration import ClickedMarkings
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
)
from worldpose.static_calibration.evidence import gather
from worldpose.static_calibration.parameters import PARAMETERS, CameraEstimate
from worldpose.static_calibration.report import StaticCalibration
from worldpose.static_calibration.reporting import report_of
from worldpose.static_calibration.screening import (
    Screened,
    held_out_error,
    screen,
)
from worldpose.static_calibration.settings import StaticCalibrationSettings
from worldpose.static_calibration.starts import from_homographies, plausible_cameras

_COARSE: Final = 60.0
"""Cauchy scale of all residuals while starts compete [standard deviations]: the pull of what is
hundreds of pixels off is bounded, and that of tens is not."""
_CLOSE: Final = 4.0
"""Mean loss of an observation [1] above which a homography's camera is not trusted and the search
over plausible cameras begins."""
_STEPS: Final = 12
"""Iterations of a start before the best are chosen [1]."""
_FOR_K3: Final = 24
"""Fewest residuals that k3 is tried with [1]: twice the parameters."""


def calibrate(
    pitch: PitchTemplate,
    clicked: ClickedMarkings,
    image_size: tuple[int, int],
    *,
    picture: NDArray[np.uint8] | None = None,
    settings: StaticCalibrationSettings = StaticCalibrationSettings(),  # noqa: B008
    where: str = "clicked markings",
) -> StaticCalibration:
    """Return the camera that took a picture, and how well it is known.

    Stage 1 finds starts: homographies of the flattened pitch, or plausible cameras where clicks
    are too few for one. Stage 2 fits pose, focal length, principal point and distortion on the
    crowned pitch, names wrong clicks and leaves them out. Stage 3 refines on the painted lines
    where there is a picture.

    Args:
        pitch: the stadium's template.
        clicked: named points, and pixels along named markings.
        image_size: width, height [px].
        picture: (height, width) or (height, width, 3); without it there is no stage 3.
        settings: noise, prior and thresholds.
        where: file or camera, for messages.

    Raises:
        InputError: a name is unknown, a pixel lies outside the picture, names are mirrored, the
            clicks contradict each other, or they do not determine the camera; the message says
            what to add and where.

    Note:
        C1-C5; paper section "Static Camera Calibration".
    """
    evidence = gather(pitch, clicked, image_size, settings.sample_spacing, where)
    check_amount(evidence, pitch, where)
    problem = problem_of(evidence, image_size, settings)
    fit = screen(problem, _start(problem, settings), settings)
    problem = problem.surveyed_from(fit.row, settings)
    check_agreement(problem, fit, settings, where)
    check_determined(problem, fit, pitch, settings, where)
    problem, fit, decisions = _with_k3(problem, fit, settings)
    estimate = CameraEstimate(camera_of_row(fit.row, image_size), fit.covariance)
    lines = None
    if picture is not None and settings.lines:
        fit, lines = refine_and_judge(problem, fit, pitch, picture, settings)
        estimate = lines.estimate
    report = report_of(estimate, problem, fit, decisions, lines, pitch, settings)
    return StaticCalibration(estimate, report)


def _start(problem: Problem, settings: StaticCalibrationSettings) -> NDArray[np.float64]:
    """Return the (22,) camera to screen from."""
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

    What is far off first pulls every start into its basin; then the sharper loss decides, which
    a marking under a wrong name cannot outvote.
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
    """Return problem and fit with k3 where held-out error earns it, and the figures (C5)."""
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
