"""Calibration report: residuals, outliers, expected ground error and warnings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.static_calibration.ground_error import GroundErrorMap
from worldpose.static_calibration.line_refinement import LineRefinement
from worldpose.static_calibration.parameters import CameraEstimate


@dataclass(frozen=True, eq=False)
class PointResidual:
    """Residual of a clicked point.

    Attributes:
        name: of the template.
        pixel: (2,) [px], the click.
        residual: (2,) [px], projected minus clicked; NaN where the camera cannot image the point.
        surprise: Mahalanobis distance from the prediction by the other evidence [1]; infinite where
            the camera cannot image the point.
        inlier: whether the fit includes the click.
        problem: reason for exclusion; empty for inliers.
    """

    name: str
    pixel: NDArray[np.float64]
    residual: NDArray[np.float64]
    surprise: float
    inlier: bool
    problem: str = ""


@dataclass(frozen=True)
class MarkingResidual:
    """Residual of a drawn marking.

    Attributes:
        name: of the template.
        pixels: number of drawn pixels [1].
        rms: of their distances to the projected marking [px].
        worst: largest distance [px].
        inlier: whether the fit includes the marking.
    """

    name: str
    pixels: int
    rms: float
    worst: float
    inlier: bool


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


@dataclass(frozen=True, eq=False)
class StaticCalibration:
    """Calibration result of one static camera.

    Attributes:
        estimate: camera and covariance.
        report: residuals and warnings.
    """

    estimate: CameraEstimate
    report: CalibrationReport
