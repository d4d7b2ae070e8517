"""Levenberg-Marquardt on clicks, drawn markings and priors, compiled (C3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.cameras import LensCalibration
from worldpose.geometry import Camera, Rigid
from worldpose.static_calibration.descent import Measurements, Solutions, descend
from worldpose.static_calibration.evidence import Evidence, count_neighbors
from worldpose.static_calibration.parameters import PARAMETERS
from worldpose.static_calibration.residuals import SIZE
from worldpose.static_calibration.settings import StaticCalibrationSettings

_ITERATIONS: Final = 60
"""Enough from any start in the basin; most end after ten."""
_MIN_DEPTH: Final = 1.0
"""Depth [m] below which no point is clicked: the camera is far from the answer."""
_MIN_HEIGHT: Final = 0.5
"""Height [m] below which the prior pushes a camera up as strongly as at this height."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Observations, noise and prior of a camera fit, as the compiled kernels expect them.

    Attributes:
        evidence: clicks and drawn markings.
        image_size: width, height [px].
        prior: (21,), see `prior_residuals`.
        free: (12,) parameters to solve for.
        click_noise: standard deviation of each click (n,), each axis [px].
        drawn_noise: standard deviation of each drawn pixel (d,), across its marking [px]: larger
            where other pixels are close, so that a marking counts by its length.
        drawn_loss: Cauchy scale of drawn points [standard deviations].
        where: file or camera, for messages.
        lens: the given lens that `prior` contains; None = none is known.
    """

    evidence: Evidence
    image_size: tuple[int, int]
    prior: NDArray[np.float64]
    free: NDArray[np.bool_]
    click_noise: NDArray[np.float64]
    drawn_noise: NDArray[np.float64]
    drawn_loss: float
    where: str = "clicked markings"
    lens: LensCalibration | None = None

    @property
    def half_diagonal(self) -> float:
        """Half the image diagonal [px]."""
        return 0.5 * float(np.hypot(*self.image_size))

    def select(self, points: NDArray[np.bool_], markings: NDArray[np.bool_]) -> Problem:
        """Return the problem restricted to some clicked points (n,) and drawn markings (m,)."""
        return replace(
            self,
            evidence=self.evidence.select(points, markings),
            click_noise=self.click_noise[points],
            drawn_noise=self.drawn_noise[markings[self.evidence.drawn_marking]],
        )

    def on_evidence(self, evidence: Evidence) -> Problem:
        """Return the problem with the same clicks at other places of the world."""
        return replace(self, evidence=evidence)

    def with_survey_error(
        self, row: NDArray[np.float64], settings: StaticCalibrationSettings
    ) -> Problem:
        """Return the problem with click noise that includes the projected survey error.

        A survey error that is equal along all three axes is the same along both image axes: the
        error in meters times focal length over depth.

        Args:
            row: (22,) camera near the answer.
            settings: noise of clicks and survey.
        """
        depth = self.evidence.points_world @ row[15:18] + row[20]
        meter = np.where(depth > _MIN_DEPTH, row[0] / np.maximum(depth, _MIN_DEPTH), 0.0)
        return replace(
            self, click_noise=np.hypot(settings.click_noise_px, settings.survey_error_m * meter)
        )


@dataclass(frozen=True, eq=False)
class Fits:
    """Fitted cameras, their costs and information matrices.

    Attributes:
        rows: (b, 22) cameras, see `worldpose.geometry.projection`.
        cost: (b,) half the sum of squared, loss-weighted residuals and priors.
        information: (b, 12, 12) inverse covariance of a step from the evidence and the prior.
        evidence_information: (b, 12, 12) contribution of the evidence alone.
    """

    rows: NDArray[np.float64]
    cost: NDArray[np.float64]
    information: NDArray[np.float64]
    evidence_information: NDArray[np.float64]


def build_problem(
    evidence: Evidence,
    image_size: tuple[int, int],
    settings: StaticCalibrationSettings,
    distortion: str | None = None,
    where: str = "clicked markings",
    lens: LensCalibration | None = None,
) -> Problem:
    """Return the fit problem of evidence and settings.

    Args:
        evidence: clicks and drawn markings.
        image_size: width, height [px].
        settings: noise, prior, free coefficients.
        distortion: radial coefficients to solve for, if not those of the settings.
        where: file or camera, for messages.
        lens: replaces the prior of focal length, principal point and distortion.
    """
    width, height = image_size
    known = settings.prior
    radial = {"none": 0, "k1": 1, "k1_k2": 2, "k1_k2_k3": 3}[distortion or settings.distortion]
    free = np.ones(len(PARAMETERS), dtype=np.bool_)
    free[9 + radial :] = False
    middle = (0.5 * (width - 1), 0.5 * (height - 1))
    prior = [np.log(known.focal * width), known.log_focal_std]
    prior += [*middle, known.principal_point_std * width, 0.5 * np.hypot(width, height)]
    prior += [known.k1_std, known.k2_std, known.k3_std]
    prior += [np.log(known.height_m), known.log_height_std]
    prior += [np.log(known.distance_m), known.log_distance_std, known.roll_std_rad, _MIN_HEIGHT]
    prior += [*known.lens_std, known.k1, 0.0, 0.0]
    if lens is not None:
        reach = (0.5 * np.hypot(width, height) / lens.focal_px) ** 2
        k1, k2, _, _, k3 = lens.distortion
        prior[:2] = [np.log(lens.focal_px), lens.focal_std_px / lens.focal_px]
        prior[2:5] = [*lens.principal_point_px, lens.principal_point_std_px]
        prior[6:9] = [lens.distortion_std] * 3
        prior[15:] = [0.0, 0.0, 0.0, k1 * reach, k2 * reach**2, k3 * reach**3]
    return Problem(
        evidence=evidence,
        image_size=image_size,
        prior=np.array(prior),
        free=free,
        click_noise=np.full(len(evidence.points), settings.click_noise_px),
        drawn_noise=settings.drawn_noise_px
        * np.sqrt(count_neighbors(evidence, settings.drawn_correlation_px)),
        drawn_loss=settings.drawn_loss_scale,
        where=where,
        lens=lens,
    )


def adjust(
    problem: Problem,
    rows: NDArray[np.float64],
    *,
    click_loss: float = np.inf,
    iterations: int = _ITERATIONS,
) -> Fits:
    """Return cameras fitted from starts.

    Args:
        problem: evidence, noise and prior.
        rows: (b, 22) starts.
        click_loss: Cauchy scale of clicks [standard deviations]; infinite = least squares.
        iterations: at most; 0 only evaluates the starts.
    """
    count, evidence = len(rows), problem.evidence
    starts = rows.copy()
    if problem.lens is not None:
        starts[:, 6:8] = problem.lens.distortion[2:4]  # tangential terms, which no fit changes
    found = Solutions(
        rows=starts,
        cost=np.empty(count),
        information=np.empty((count, SIZE, SIZE)),
        observed=np.empty((count, SIZE, SIZE)),
    )
    given = Measurements(
        points_world=evidence.points_world,
        points_image=evidence.points_image,
        samples_world=evidence.samples_world,
        bounds=evidence.bounds,
        drawn_image=evidence.drawn_image,
        drawn_marking=evidence.drawn_marking,
        prior=problem.prior,
        free=problem.free,
        click_noise=problem.click_noise,
        drawn_noise=problem.drawn_noise,
        half_diagonal=problem.half_diagonal,
        click_loss=float(click_loss),
        drawn_loss=float(problem.drawn_loss),
    )
    descend(given, iterations, found)
    return Fits(found.rows, found.cost, found.information, found.observed)


def camera_row(camera: Camera) -> NDArray[np.float64]:
    """Return the (22,) row of a single camera; the solver checks lens folds itself."""
    pose = camera.cam_from_world
    return np.concatenate(
        [
            camera.focal,
            camera.principal_point,
            camera.distortion,
            pose.rotation.ravel(),
            pose.translation,
            [np.inf],
        ]
    )


def camera_from_row(row: NDArray[np.float64], image_size: tuple[int, int]) -> Camera:
    """Return the camera of a row."""
    u, _, v = np.linalg.svd(row[9:18].reshape(3, 3))
    return Camera(
        focal=row[:2],
        principal_point=row[2:4],
        distortion=row[4:9],
        cam_from_world=Rigid(u @ v, row[18:21]),
        image_size=np.array(image_size),
    )
