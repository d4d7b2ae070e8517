"""Calibration report: residuals, outliers, expected ground error and warnings, and its storage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.cameras import LensCalibration
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera, camera_arrays
from worldpose.geometry.rays import RayStatus
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.click_outliers import Explanation, InlierFit
from worldpose.static_calibration.fit import CameraProblem, compute_residuals
from worldpose.static_calibration.ground_error import (
    GroundErrorMap,
    ground_error_map,
    propose_clicks,
)
from worldpose.static_calibration.lens_choice import describe_misfit
from worldpose.static_calibration.line_refinement import LineRefinement
from worldpose.static_calibration.parameters import PARAMETERS, CameraEstimate
from worldpose.static_calibration.residuals import drawn_residuals
from worldpose.static_calibration.settings import StaticCalibrationSettings


@dataclass(frozen=True, eq=False)
class PointResidual:
    """Residual of a clicked point of the template.

    Attributes:
        pixel: (2,) [px], the click.
        residual: (2,) [px], projected minus clicked; NaN where the camera cannot image the point.
        mahalanobis: Mahalanobis distance from the prediction by the other evidence [1]; infinite
            where the camera cannot image the point.
        problem: reason for exclusion; empty for inliers.
    """

    name: str
    pixel: Floats
    residual: Floats
    mahalanobis: float
    inlier: bool
    problem: str = ""


@dataclass(frozen=True)
class MarkingResidual:
    """Residual of a drawn marking of the template: `inlier` is whether the fit includes it.

    Attributes:
        pixels: number of drawn pixels [1].
        rms: root mean square of their distances to the projected marking [px].
        worst: largest distance [px].
    """

    name: str
    pixels: int
    rms: float
    worst: float
    inlier: bool


_GROUND_ERROR: Final = "expected ground error"
"""Beginning of reasons that state an uncertainty, not a contradiction."""


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """Accuracy of a calibrated camera, its residuals and warnings.

    Attributes:
        stage: last stage that contributes to the camera: `points` (stages 1 and 2), `lines` (3).
        free: names of the estimated parameters, of `PARAMETERS`.
        decisions: model choices and the metrics behind them.
        points: residuals of all clicks, by falling Mahalanobis distance.
        drawn: residuals of drawn markings, the worst first.
        wrong: names of excluded clicks, by falling Mahalanobis distance, then of excluded drawn
            markings.
        noise_scale: estimated noise over the stated noise [1]: 1 unless the residuals clearly
            contradict the stated noise.
        click_noise: standard deviation of the inlying clicks, estimated from their residuals, each
            axis [px]; NaN without degrees of freedom.
        click_freedom: degrees of freedom of that estimate [1].
        condition: condition number of the free parameters' correlation matrix [1].
        ground_error: the coverage map.
        weak: whether a person must review this camera.
        reasons: why it is weak.
        add_next: clicks that would lower the expected ground error most, the best first.
        lines: result of stage 3; None without an image.
    """

    stage: str
    free: tuple[str, ...]
    decisions: tuple[str, ...]
    points: tuple[PointResidual, ...]
    drawn: tuple[MarkingResidual, ...]
    wrong: tuple[str, ...]
    noise_scale: float
    click_noise: float
    click_freedom: float
    condition: float
    ground_error: GroundErrorMap
    weak: bool
    reasons: tuple[str, ...]
    add_next: tuple[str, ...]
    lines: LineRefinement | None

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Reasons other than the expected ground error, whose effect on people is measured."""
        return tuple(each for each in self.reasons if not each.startswith(_GROUND_ERROR))


@dataclass(frozen=True, eq=False)
class StaticCalibration:
    """Calibration result of one static camera: camera with covariance, and report."""

    estimate: CameraEstimate
    report: CalibrationReport


_CANNOT_IMAGE: Final = {
    RayStatus.MISSING: "cannot be imaged: the camera is not known",
    RayStatus.BEHIND: "cannot be imaged: the point is behind the camera",
    RayStatus.BEYOND_FOLD: "cannot be imaged: the point is outside the lens's field of view",
}


def build_report(
    estimate: CameraEstimate,
    found: Explanation,
    lines: LineRefinement | None,
    pitch: PitchTemplate,
    stated: float,
) -> CalibrationReport:
    """Return the report of the final camera, with stated click noise [px].

    `found` is stage 2; its settings have the estimated click noise. `lines` is stage 3; None
    without an image.
    """
    problem, fit, settings = found.problem, found.fit, found.settings
    evidence = problem.evidence
    scale = fit.noise_scale * settings.click_noise_px / stated
    residuals = compute_residuals(problem, estimate.camera.numbers)
    points = _point_residuals(estimate.camera, found, residuals.click)
    drawn = []
    for index, name in enumerate(evidence.markings):
        off = residuals.drawn[evidence.drawn_marking == index]
        rms, worst = float(np.sqrt(np.mean(off**2))), float(np.abs(off).max())
        drawn.append(MarkingResidual(name, len(off), rms, worst, bool(fit.markings[index])))
    ground_error = ground_error_map(estimate, pitch, settings.map_step_m)
    reasons = _accuracy_reasons(ground_error, fit, settings)
    # Few clicks, or a view from straight above, leave more than a fifth to the prior.
    if (open_focal := float(np.sqrt(estimate.covariance[6, 6]))) > 0.2:
        reasons.append(
            f"height {estimate.camera.center[2]:.1f} m and focal length "
            f"{estimate.camera.focal[0]:.0f} px are open, give or take {open_focal:.0%}: click "
            "points above the ground, or import a lens (worldpose import --lens)"
        )
    misfit = describe_misfit(found)
    if reasons and not misfit and scale >= 3.0:
        misfit = (
            f"the errors of clicks are {scale:.1f} times the stated noise with every lens model "
            "that was tried: check the names, or calibrate the lens (worldpose calibrate)"
        )
    reasons += [misfit] if misfit else []
    decisions = list(found.assumptions)
    # The heights of the image's axes, right and down, tell the roll unless it looks straight down.
    right, down = estimate.camera.cam_from_world.rotation[:2, 2]
    if max(abs(right), down) > 0.1:
        roll = np.degrees(np.arctan2(-right, -down))
        decisions.append(f"the camera is rolled by {roll:+.0f} degrees, clockwise from behind")
    if abs(scale - 1.0) > 0.01:
        decisions.append(
            f"the errors of clicks and drawn pixels are {scale:.2g} times the stated noise; the "
            "calibration uses this noise"
        )
    if lines is not None:
        samples = f"{lines.effective_samples:.0f} independent samples" if lines.refined else "none"
        decisions.append(f"painted lines: {lines.reason or samples}")
        if not lines.refined:
            reasons.append(f"no painted lines to confirm it: {lines.reason}")
        # Real pitches have up to 0.027 m, and 0.055 m with a length and width 1 m off.
        uneven = 0.0 if lines.noise is None else lines.noise.unevenness_m
        if uneven > 0.02 and pitch.assumed & {"length", "width"}:
            decisions.append(
                f"the painted lines lie {100.0 * uneven:.1f} cm off their places on a pitch of "
                f"{pitch.length:g} x {pitch.width:g} m, the standard size: survey its corners "
                "(points in pitch.json), or correct length and width"
            )
    deviations = _lens_deviations(problem.lens, estimate.camera, problem.half_diagonal)
    if deviations:
        most = max(deviations, key=lambda name: deviations[name])
        said = f"the given lens: the {most} is {deviations[most]:.1f} standard deviations off it"
        decisions.append(said)
        if deviations[most] > 4.0:
            reasons.append(
                f"the clicks contradict {said}. Check that it is this camera's lens at this zoom "
                "and image size, or state larger deviations"
            )
    decisions += [
        _true_name(int(index), estimate, problem, pitch, settings)
        for index in np.flatnonzero(~fit.markings)
    ]
    clicked = (*evidence.points, *evidence.markings)
    inner = fit.covariance[np.ix_(problem.free, problem.free)]
    spread = np.sqrt(np.diag(inner))
    return CalibrationReport(
        stage="lines" if lines is not None and lines.refined else "points",
        free=tuple(name for name, free in zip(PARAMETERS, problem.free, strict=True) if free),
        decisions=tuple(decisions),
        points=points,
        drawn=tuple(sorted(drawn, key=lambda marking: -marking.rms)),
        wrong=(
            *(point.name for point in points if not point.inlier),
            *(marking.name for marking in drawn if not marking.inlier),
        ),
        noise_scale=scale,
        click_noise=fit.click_noise,
        click_freedom=fit.click_freedom,
        condition=float(np.linalg.cond(inner / np.outer(spread, spread))),
        ground_error=ground_error,
        weak=bool(reasons),
        reasons=tuple(reasons),
        add_next=propose_clicks(estimate, pitch, clicked, settings.click_noise_px),
        lines=lines,
    )


def _point_residuals(
    camera: Camera, found: Explanation, residuals: Floats
) -> tuple[PointResidual, ...]:
    """Return the residuals (n, 2) [px] of all clicks, by falling Mahalanobis distance."""
    evidence, fit = found.problem.evidence, found.fit
    problems = image_problems(camera, evidence.points_world)
    imaged = np.array([not problem for problem in problems], dtype=np.bool_)
    mahalanobis = np.where(imaged, fit.mahalanobis, np.inf)
    return tuple(
        PointResidual(
            evidence.points[i],
            evidence.points_image[i],
            np.where(imaged[i], residuals[i], np.nan),
            float(mahalanobis[i]),
            bool(fit.inliers[i]),
            "" if fit.inliers[i] else problems[i] or f"{np.linalg.norm(residuals[i]):.0f} px off",
        )
        for i in np.argsort(-mahalanobis, kind="stable")
    )


def _accuracy_reasons(
    ground_error: GroundErrorMap, fit: InlierFit, settings: StaticCalibrationSettings
) -> list[str]:
    """Return why expected ground error and residuals require a review."""
    reasons = []
    if ground_error.median > settings.weak_median_m:
        reasons.append(
            f"{_GROUND_ERROR} {ground_error.median:.2f} m (median over the seen pitch), "
            f"over {settings.weak_median_m:g} m"
        )
    if ground_error.p95 > settings.weak_p95_m:
        reasons.append(
            f"{_GROUND_ERROR} {ground_error.p95:.2f} m on the worst twentieth of the seen "
            f"pitch, over {settings.weak_p95_m:g} m"
        )
    if fit.misfit > 4.0 * fit.noise_scale**2:
        reasons.append(
            f"residuals {np.sqrt(fit.misfit):.1f} times the stated noise: a name may be wrong"
        )
    return reasons


def image_problems(camera: Camera, places: Floats) -> tuple[str, ...]:
    """Return why a camera cannot image places (n, 3) [m], world; empty strings if it can."""
    status = camera.project_with_jacobians(places).status
    return tuple(_CANNOT_IMAGE.get(RayStatus(code), "") for code in status.tolist())


def _lens_deviations(
    lens: LensCalibration | None, camera: Camera, half_diagonal: float
) -> dict[str, float]:
    """Return by how many standard deviations a camera differs from the given lens; empty if none.

    Not from the prior: an assumption, such as a cropped image, may have widened it.
    """
    if lens is None:
        return {}
    focal, middle = float(camera.focal[0]), camera.principal_point - lens.principal_point_px
    reach = (half_diagonal / focal) ** 2
    given = (half_diagonal / lens.focal_px) ** 2
    stated = Camera.from_lens(lens).distortion
    corner = [
        camera.distortion[i] * reach**power - stated[i] * given**power
        for power, i in ((1, 0), (2, 1), (3, 4))
    ]
    return {
        "focal length": abs(np.log(focal / lens.focal_px)) * lens.focal_px / lens.focal_std_px,
        "principal point": float(np.hypot(middle[0], middle[1])) / lens.principal_point_std_px,
        "distortion": float(np.abs(corner).max()) / lens.distortion_std,
    }


def _true_name(
    index: int,
    estimate: CameraEstimate,
    problem: CameraProblem,
    pitch: PitchTemplate,
    settings: StaticCalibrationSettings,
) -> str:
    """Return a sentence on the marking that the pixels of a misnamed marking lie on."""
    evidence = problem.evidence
    pixels = evidence.drawn_image[evidence.drawn_marking == index]
    every = np.zeros(len(pixels), dtype=np.int64)
    off, by_step = np.empty(len(pixels)), np.empty((len(pixels), STEP))
    row = estimate.camera.numbers
    worst = {}
    for name in pitch.marking_names:
        samples = pitch.marking_points(name, settings.sample_spacing_m)
        bounds = np.array([0, len(samples)])
        drawn_residuals(row, problem.half_diagonal, samples, bounds, pixels, every, off, by_step)
        worst[name] = float(np.abs(off).max())
    nearest = min(worst, key=lambda name: worst[name])
    drawn = f"{evidence.markings[index]} left out: its pixels lie"
    if worst[nearest] > settings.wrong_marking * settings.drawn_noise_px:
        return f"{drawn} on no marking"
    return f"{drawn} on {nearest}, {worst[nearest]:.1f} px off at most"


def calibration_arrays(calibration: StaticCalibration) -> dict[str, NDArray[Any]]:
    """Return a camera's stored arrays by name; those of `camera_arrays` if it was given."""
    report = calibration.report
    mahalanobis = np.array([p.mahalanobis for p in report.points], dtype=np.float64)
    venue = None if report.lines is None else report.lines.venue
    return {
        **({} if venue is None else venue.to_arrays()),
        **camera_arrays(calibration.estimate.camera),
        "covariance": calibration.estimate.covariance,
        "point_pixel": np.array([p.pixel for p in report.points]).reshape(-1, 2),
        "point_residual": np.array([p.residual for p in report.points]).reshape(-1, 2),
        "point_surprise": np.where(np.isfinite(mahalanobis), mahalanobis, np.nan),
        "point_inlier": np.array([p.inlier for p in report.points], dtype=np.bool_),
        "marking_rms": np.array([m.rms for m in report.drawn], dtype=np.float64),
        "marking_worst": np.array([m.worst for m in report.drawn], dtype=np.float64),
        "marking_inlier": np.array([m.inlier for m in report.drawn], dtype=np.bool_),
        "ground_error": report.ground_error.expected,
    }


def uncalibrated_attributes(camera_id: str, origin: str, *reasons: str) -> dict[str, Any]:
    """Return the stored attributes of a camera that is given, or left out for a reason."""
    lists = ("point", "point_problem", "marking", "free", "decisions", "reasons", "add_next")
    stated = {"camera_id": camera_id, "origin": origin, **{name: [] for name in lists}}
    return {**stated, "noise_scale": None, "condition": None, "reasons": list(reasons)}


def calibration_attributes(camera_id: str, calibration: StaticCalibration) -> dict[str, Any]:
    """Return the stored attributes of a calibrated camera."""
    report = calibration.report
    return {
        "camera_id": camera_id,
        "origin": report.stage,
        "point": [point.name for point in report.points],
        "point_problem": [point.problem for point in report.points],
        "marking": [marking.name for marking in report.drawn],
        "free": list(report.free),
        "decisions": list(report.decisions),
        "reasons": list(report.reasons),
        "add_next": list(report.add_next),
        "noise_scale": report.noise_scale,
        "condition": report.condition,
    }
