"""Objective of bundle adjustment, its terms and their weights.

For cameras L_c, joints X_j of people and detections x_jc of the joints that camera c shows:

    E(L, X) = sum_j sum_c I_jc rho(|Pi(X_j; L_c) - x_jc|^2 / s_jc^2) + sum_c d_c^T C_c^-1 d_c

The first sum is the paper's over people, with the noise s_jc [px] of the keypoints and Cauchy's
loss rho. In place of its sum over field markings stands the posterior of calibration, which used
them: d_c is the step of camera c from there, and C_c its covariance. With markings alone, the
points are fixed, rho is the square, and C_c is wide.

`schur_complement.cost` and `eliminate` compute the first sum with joints eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from worldpose.bundle_adjustment.clip import Clip, Observations
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, SolverSettings
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.covariance import invert_free
from worldpose.geometry.optimize.losses import MEDIAN_SQUARED, cauchy_weight
from worldpose.static_calibration.parameters import project_with_jacobian

MARKINGS_SOLVER: Final = SolverSettings(max_iterations=500, min_cost_change=1e-6)
"""For ill-conditioned directions as long and flat as those of a lens determined by six clicks."""


@dataclass(frozen=True, eq=False)
class AdjustmentProblem:
    """Bundle adjustment problem: initial cameras and points, pixels and priors.

    Attributes:
        cameras: (cameras,) batch with square pixels.
        free: (cameras, 12) bool, parameters that may move, in the order of `PARAMETERS`.
        camera_information: (cameras, 12, 12) information of a step from `cameras`: the prior,
            without the observations here.
        points: (points, 3) [m], world.
        point_information: (points,) [1/m^2] per axis; 0 = free, infinite = fixed where it is.
        point_of: (n,) point of every observation, ascending.
        camera_of: (n,) its camera.
        image: (n, 2) [px].
        weight: (n,) [1/px^2], one over the variance per image axis.
        scale: (n,) standard deviations beyond which an observation counts less (Cauchy's loss);
            infinite = plain squares.
        names: names of the cameras, for messages; empty = not known.
    """

    cameras: Camera
    free: Flags
    camera_information: Floats
    points: Floats
    point_information: Floats
    point_of: Integers
    camera_of: Integers
    image: Floats
    weight: Floats
    scale: Floats
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class AdjustmentSolution:
    """Solution of a bundle adjustment problem.

    Attributes:
        cameras: (cameras,) batch.
        offset: (cameras, 12) steps from the problem's cameras to these.
        points: (points, 3) [m], world.
        cost: robust sum of squares with priors.
        converged: whether the last step gained less than `min_cost_change`.
        camera_covariance: (12 cameras, 12 cameras) covariance of steps from the solution, the
            points being free; zero for fixed parameters, empty if not requested.
    """

    cameras: Camera
    offset: Floats
    points: Floats
    cost: float
    converged: bool
    camera_covariance: Floats


def prior_cost(offset: Floats, information: Floats) -> float:
    """Return the second sum for steps (cameras, 12) from calibration with information."""
    return float(np.einsum("ci,cij,cj->", offset, information, offset))


@dataclass(frozen=True)
class KeypointNoise:
    """Scale and temporal correlation of keypoint errors.

    Attributes:
        scale: factor on the stated standard deviation [1].
        correlation: observations that equal one independent observation [1], at least 1: a detector
            that puts a joint too low in one frame puts it too low in the next.
    """

    scale: float = 1.0
    correlation: float = 1.0


def players_problem(
    clip: Clip,
    observed: Observations,
    noise: KeypointNoise,
    fixed: Flags,
    settings: BundleAdjustmentSettings,
    variance_factor: Floats | float = 1.0,
) -> AdjustmentProblem:
    """Return the adjustment of cameras to people, with calibration as the prior.

    Clicks, painted lines and priors enter as the Gaussian posterior of calibration, people as free
    points under Cauchy's loss. The correlation divides an observation's weight, so that twenty
    frames with the same detector error count as few. The variance that calibration states is
    multiplied by a factor (cameras,) [1].
    """
    information, free = camera_knowledge(clip, settings)
    information = information / np.reshape(variance_factor, (-1, 1, 1))
    free = free & ~fixed[:, None]
    return free_joints_problem(
        clip.cameras, free, information, observed, noise, settings.loss_scale, clip.names
    )


def free_joints_problem(
    cameras: Camera,
    free: Flags,
    information: Floats,
    observed: Observations,
    noise: KeypointNoise,
    loss_scale: float,
    names: tuple[str, ...],
) -> AdjustmentProblem:
    """Return the adjustment of cameras to joints without a prior of their places.

    Of a batch (cameras,), `free` is (cameras, 12) as in `AdjustmentProblem`, the prior of a step is
    `information` (cameras, 12, 12). The scale of Cauchy's loss is in standard deviations.
    """
    variance = (observed.noise * noise.scale) ** 2 * noise.correlation
    return AdjustmentProblem(
        cameras=cameras,
        free=free,
        camera_information=information,
        points=observed.points,
        point_information=np.zeros(len(observed.points)),
        point_of=observed.point_of,
        camera_of=observed.camera_of,
        image=observed.image,
        weight=1.0 / variance,
        scale=np.full(len(variance), loss_scale / np.sqrt(noise.correlation)),
        names=names,
    )


def estimate_variance_factor(problem: AdjustmentProblem, adjusted: AdjustmentSolution) -> Floats:
    """Return the factor (cameras,) on calibration's variances, estimated from an adjustment.

    People move a camera in the directions that they determine; where its step is longer than its
    calibration allows, the calibration was overconfident. The squared step in stated standard
    deviations is divided by the number of these directions (MacKay 1992), shrunk towards the median
    of all cameras.
    """
    weight = 10.0  # in directions: as many as one camera has
    count = len(problem.free)
    step = adjusted.offset
    squared = np.einsum("ci,cij,cj->c", step, problem.camera_information, step)
    blocks = adjusted.camera_covariance.reshape(count, STEP, count, STEP)
    own = blocks[np.arange(count), :, np.arange(count)]
    kept = np.einsum("cij,cji->c", problem.camera_information, own)
    told = np.maximum(problem.free.sum(axis=1) - kept, 0.0)
    # Use the median: a camera that shows other people must not free all the others.
    overall = float(np.median((squared + 1.0) / (told + 1.0)))
    return np.asarray((squared + weight * overall) / (told + weight))


def markings_problem(
    clip: Clip, fixed: Flags, settings: BundleAdjustmentSettings
) -> AdjustmentProblem:
    """Return the adjustment of cameras to clicks alone, all parameters free, without a prior."""
    # In rad, m, 1, px, 1; a hundredth of it would already constrain the lens.
    spread = 100.0 * np.array([1.0] * 3 + [100.0] * 3 + [1.0, 300.0, 300.0, 3.0, 30.0, 300.0])
    clicked = [np.flatnonzero(clicks.inlier) for clicks in clip.clicks]
    points = [clicks.points_world[i] for clicks, i in zip(clip.clicks, clicked, strict=True)]
    image = [clicks.points_image[i] for clicks, i in zip(clip.clicks, clicked, strict=True)]
    world = np.concatenate(points)
    has = np.array([len(i) > 0 for i in clicked])
    return AdjustmentProblem(
        cameras=clip.cameras,
        free=np.repeat((has & ~fixed)[:, None], STEP, axis=1),
        camera_information=np.tile(np.diag(spread**-2.0), (len(has), 1, 1)),
        points=world,
        point_information=np.full(len(world), np.inf),
        point_of=np.arange(len(world)),
        camera_of=np.repeat(np.arange(len(has)), [len(i) for i in clicked]),
        image=np.concatenate(image),
        weight=np.full(len(world), settings.click_noise_px**-2.0),
        scale=np.full(len(world), np.inf),
        names=clip.names,
    )


def camera_knowledge(clip: Clip, settings: BundleAdjustmentSettings) -> tuple[Floats, Flags]:
    """Return the prior information (cameras, 12, 12) on a step, and the free ones (cameras, 12)."""
    known = known_covariance(clip, settings)
    free: Flags = np.diagonal(known, axis1=1, axis2=2) > 0.0
    return np.stack([invert_free(*each) for each in zip(known, free, strict=True)]), free


def known_covariance(clip: Clip, settings: BundleAdjustmentSettings) -> Floats:
    """Return the prior covariance (cameras, 12, 12) of a step by the camera's source."""
    count = len(clip.covariance)
    distance = clip.distance
    usual = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 1.0
    distance = np.where(np.isfinite(distance), distance, usual)
    given = settings.given
    spread = np.zeros((count, STEP))
    spread[:, :3] = given.rotation_rad
    spread[:, 3:6] = given.center * distance[:, None]
    spread[:, 6] = given.focal
    on_lines = np.zeros(count, dtype=np.bool_) if clip.on_lines is None else clip.on_lines
    factor = np.where(on_lines, settings.lines_uncertainty, settings.clicks_uncertainty)
    return np.where(
        clip.given[:, None, None],
        spread[:, :, None] ** 2 * np.eye(STEP),
        factor[:, None, None] ** 2 * clip.covariance,
    )


def player_residuals(cameras: Camera, points: Floats, observed: Observations) -> Floats:
    """Return Pi(X_j; L_c) - x_jc [px] (n, 2) of keypoints at points X (points, 3) [m]."""
    off = np.empty_like(observed.image)
    for c in range(len(cameras.focal)):
        rows = observed.camera_of == c
        off[rows] = cameras[c].project(points[observed.point_of[rows]]) - observed.image[rows]
    return off


def keypoint_information(cameras: Camera, observed: Observations) -> Floats:
    """Return the information of keypoints on a step of each camera (cameras, 12, 12).

    The points are fixed, and the noise is as stated.
    """
    information = np.zeros((len(cameras.focal), STEP, STEP))
    for c in range(len(information)):
        rows = observed.camera_of == c
        _, by_step = project_with_jacobian(cameras[c], observed.points[observed.point_of[rows]])
        by_step = by_step / observed.noise[rows][:, None, None]
        by_step = by_step[np.isfinite(by_step).all(axis=(1, 2))]
        information[c] = np.einsum("nai,naj->ij", by_step, by_step)
    return information


def estimate_noise(
    cameras: Camera, points: Floats, observed: Observations, robust_scale: float
) -> KeypointNoise:
    """Return the scale and the correlation of the errors of keypoints of adjusted points.

    The scale comes from the median; every point takes three degrees of freedom out of its
    observations. The correlation is the squared length of the sum of a joint's residuals over time,
    in one camera, over the sum of their squared lengths; 1 for independent residuals.
    """
    off = player_residuals(cameras, points, observed) / observed.noise[:, None]
    views = np.bincount(observed.point_of, minlength=len(points))[observed.point_of]
    squared = (off**2).sum(axis=1) / (1.0 - 1.5 / np.maximum(views, 2))
    scale = (
        float(np.sqrt(np.median(squared[views > 2]) / MEDIAN_SQUARED)) if (views > 2).any() else 1.0
    )
    # Far below any detector's noise; the weights of exact keypoints would leave no digits for the
    # prior, which alone holds the place of all cameras together.
    scale = max(scale, 1e-3)
    pull = off * cauchy_weight((off**2).sum(axis=1), robust_scale * scale)[:, None]
    series = (observed.camera_of * (observed.person_of.max() + 1) + observed.person_of) * 17
    _, series = np.unique(series + observed.joint_of, return_inverse=True)
    summed = np.stack([np.bincount(series, pull[:, axis]) for axis in range(2)])
    correlation = float((summed**2).sum() / (pull**2).sum())
    return KeypointNoise(scale, max(1.0, correlation))
