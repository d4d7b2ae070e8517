"""Assembly of the calibration report from a fit."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera, RayStatus
from worldpose.pitch import PitchTemplate
from worldpose.static_calibration.adjustment import Problem, row_of
from worldpose.static_calibration.click_outliers import Screened, residual_rows
from worldpose.static_calibration.ground_error import ground_error_map
from worldpose.static_calibration.line_refinement import LineRefinement
from worldpose.static_calibration.next_click import most_helpful
from worldpose.static_calibration.parameters import PARAMETERS, CameraEstimate
from worldpose.static_calibration.report import (
    CalibrationReport,
    MarkingResidual,
    PointResidual,
)
from worldpose.static_calibration.residuals import SIZE, drawn_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings

_CANNOT_IMAGE: Final = {
    RayStatus.MISSING: "cannot be imaged: the camera is not known",
    RayStatus.BEHIND: "cannot be imaged: the point is behind the camera",
    RayStatus.BEYOND_FOLD: "cannot be imaged: the point is outside the lens's field of view",
}
_SAME: Final = 0.01
"""Difference from the stated noise too small to report [1]."""
_TRUSTED: Final = 4.0
"""Maximum mean loss per observation [1] without a warning: twice the stated noise."""


def report_of(
    estimate: CameraEstimate,
    problem: Problem,
    fit: Screened,
    decisions: tuple[str, ...],
    lines: LineRefinement | None,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
    stated: float,
) -> CalibrationReport:
    """Return the report of a calibrated camera.

    Args:
        estimate: the final camera.
        problem: evidence, noise and prior of stage 2.
        fit: stage 2.
        decisions: decisions so far.
        lines: stage 3; None without an image.
        pitch: the template.
        settings: thresholds, and the estimated click noise.
        stated: stated click noise [px].
    """
    scale = fit.noise_scale * settings.click_noise / stated
    evidence = problem.evidence
    rows = residual_rows(problem, row_of(estimate.camera))
    problems = image_problems(estimate.camera, evidence.points_world)
    imaged = np.array([not problem for problem in problems], dtype=np.bool_)
    surprise = np.where(imaged, fit.surprise, np.inf)
    ranked = np.argsort(-surprise, kind="stable")
    points = tuple(
        PointResidual(
            evidence.points[i],
            evidence.points_image[i],
            np.where(imaged[i], rows.click[i], np.nan),
            float(surprise[i]),
            bool(fit.inliers[i]),
            "" if fit.inliers[i] else problems[i] or _distance(rows.click[i]),
        )
        for i in ranked
    )
    drawn = [
        _marking_residual(
            name, rows.drawn[evidence.drawn_marking == index], bool(fit.markings[index])
        )
        for index, name in enumerate(evidence.markings)
    ]
    known = ground_error_map(estimate, pitch, settings.map_step)
    reasons = []
    if known.median > settings.weak_median:
        reasons.append(
            f"expected ground error {known.median:.2f} m (median over the seen pitch), "
            f"over {settings.weak_median:g} m"
        )
    if known.p95 > settings.weak_p95:
        reasons.append(
            f"expected ground error {known.p95:.2f} m on the worst twentieth of the seen pitch, "
            f"over {settings.weak_p95:g} m"
        )
    if fit.misfit > _TRUSTED * fit.noise_scale**2:
        reasons.append(
            f"residuals {np.sqrt(fit.misfit):.1f} times the stated noise: a name may be wrong"
        )
    if abs(scale - 1.0) > _SAME:
        decisions = (
            *decisions,
            f"clicks and drawn pixels are {scale:.2g} times as far off as stated, which "
            "is taken for their noise",
        )
    if lines is not None and not lines.refined:
        reasons.append(f"no painted lines to confirm it: {lines.reason}")
    if lines is not None:
        found = f"{lines.effective_samples:.0f} independent samples" if lines.refined else "none"
        decisions = (*decisions, f"painted lines: {lines.reason or found}")
    misnamed = [
        _true_name(int(index), estimate, problem, pitch, settings)
        for index in np.flatnonzero(~fit.markings)
    ]
    clicked = (*evidence.points, *evidence.markings)
    return CalibrationReport(
        stage="lines" if lines is not None and lines.refined else "points",
        free=tuple(name for name, free in zip(PARAMETERS, problem.free, strict=True) if free),
        decisions=(*decisions, *misnamed),
        points=points,
        drawn=tuple(sorted(drawn, key=lambda marking: -marking.rms)),
        wrong=(
            *(point.name for point in points if not point.inlier),
            *(marking.name for marking in drawn if not marking.inlier),
        ),
        noise_scale=scale,
        click_noise=fit.click_noise,
        click_freedom=fit.click_freedom,
        condition=_condition(fit.covariance, problem.free),
        ground_error=known,
        weak=bool(reasons),
        reasons=tuple(reasons),
        add_next=most_helpful(estimate, pitch, clicked, settings.click_noise),
        lines=lines,
    )


def image_problems(camera: Camera, places: NDArray[np.float64]) -> tuple[str, ...]:
    """Return why a camera cannot image places (n, 3) [m], world; empty strings if it can."""
    status = camera.project_with_jacobians(places).status
    return tuple(_CANNOT_IMAGE.get(RayStatus(code), "") for code in status.tolist())


def _distance(residual: NDArray[np.float64]) -> str:
    return f"{float(np.linalg.norm(residual)):.0f} px off"


def _marking_residual(name: str, off: NDArray[np.float64], inlier: bool) -> MarkingResidual:
    rms, worst = float(np.sqrt(np.mean(off**2))), float(np.abs(off).max())
    return MarkingResidual(name, len(off), rms, worst, inlier)


def _true_name(
    index: int,
    estimate: CameraEstimate,
    problem: Problem,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
) -> str:
    """Return a sentence on the marking that the pixels of a misnamed marking lie on."""
    evidence = problem.evidence
    pixels = evidence.drawn_image[evidence.drawn_marking == index]
    every = np.zeros(len(pixels), dtype=np.int64)
    off, by_step = np.empty(len(pixels)), np.empty((len(pixels), SIZE))
    row = row_of(estimate.camera)
    worst = {}
    for name in pitch.marking_names:
        samples = pitch.marking_points(name, settings.sample_spacing)
        bounds = np.array([0, len(samples)])
        drawn_residuals(row, problem.reach, samples, bounds, pixels, every, off, by_step)
        worst[name] = float(np.abs(off).max())
    nearest = min(worst, key=lambda name: worst[name])
    drawn = f"{evidence.markings[index]} left out: its pixels lie"
    if worst[nearest] > settings.wrong_marking * settings.drawn_noise:
        return f"{drawn} on no marking"
    return f"{drawn} on {nearest}, {worst[nearest]:.1f} px off at most"


def _condition(covariance: NDArray[np.float64], free: NDArray[np.bool_]) -> float:
    inner = covariance[np.ix_(free, free)]
    spread = np.sqrt(np.diag(inner))
    return float(np.linalg.cond(inner / np.outer(spread, spread)))
