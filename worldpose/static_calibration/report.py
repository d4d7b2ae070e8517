"""What a calibration says about itself: residuals, wrong clicks, and whether to trust it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.static_calibration.ground_error import GroundErrorMap
from worldpose.static_calibration.line_refinement import LineRefinement
from worldpose.static_calibration.parameters import CameraEstimate


@dataclass(frozen=True, eq=False)
class PointResidual:
    """A clicked point against the camera.

    Attributes:
        name: of the template.
        pixel: (2,) [px], where it was clicked.
        residual: (2,) [px], projected minus clicked; NaN where the camera cannot image the point.
        surprise: residual in standard deviations of what the other evidence predicts [1]; infinite
            where the camera cannot image the point.
        inlier: does the camera rest on it.
        problem: why the camera does not rest on it; empty where it does.
    """

    name: str
    pixel: NDArray[np.float64]
    residual: NDArray[np.float64]
    surprise: float
    inlier: bool
    problem: str = ""


@dataclass(frozen=True)
class MarkingResidual:
    """A drawn marking against the camera.

    Attributes:
        name: of the template.
        pixels: how many were drawn [1].
        rms: of their distances to the projected marking [px].
        worst: largest distance [px].
        inlier: does the camera rest on it.
    """

    name: str
    pixels: int
    rms: float
    worst: float
    inlier: bool


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """How well a camera is known and why.

    Attributes:
        stage: the last one that went into the camera: `points` (stages 1 and 2), `lines` (3).
        free: parameters that were solved for, of `PARAMETERS`.
        decisions: what was chosen and the figures that decided.
        points: residuals of all clicks, the most surprising first.
        drawn: residuals of drawn markings, the worst first.
        wrong: names of clicks and drawn markings that the camera does not rest on, the most
            surprising first.
        noise_scale: factor on the stated noise that is taken [1]: 1 unless the residuals clearly
            say another.
        click_noise: standard deviation of the inlying clicks that their residuals say, each axis
            [px]; NaN without degrees of freedom.
        click_freedom: degrees of freedom that it rests on [1].
        condition: of the information about the free parameters, each in its prior's spreads [1].
        ground_error: the coverage map.
        weak: must a person look at this camera.
        reasons: why it is weak.
        add_next: clicks that would lower the expected ground error most, the best first.
        lines: what stage 3 found; None without a picture.
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
    """A static camera from its picture.

    Attributes:
        estimate: camera and covariance.
        report: residuals and trust.
    """

    estimate: CameraEstimate
    report: CalibrationReport
