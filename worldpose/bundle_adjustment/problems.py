"""Bundle adjustment problems from people and from markings (B2), and the keypoint noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats
from worldpose.bundle_adjustment.clip import Clip, Observations
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, SolverSettings
from worldpose.bundle_adjustment.solver import Problem, Solution
from worldpose.geometry.cameras import Camera
from worldpose.static_calibration.parameters import SIZE, project_with_jacobian

MEDIAN_SQUARED: Final = 2.0 * np.log(2.0)
"""Median squared length of a standard Gaussian in two dimensions [1]."""
MARKINGS_SOLVER: Final = SolverSettings(max_iterations=500, min_cost_change=1e-6)
"""For ill-conditioned directions as long and flat as those of a lens determined by six clicks."""


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
) -> Problem:
    """Return the adjustment of cameras to people, with calibration as the prior.

    Clicks, painted lines and priors enter as the Gaussian posterior of calibration, people as free
    points under Cauchy's loss. The correlation divides an observation's weight, so that twenty
    frames with the same detector error count as few. The variance that calibration states is
    multiplied by a factor (cameras,) [1].
    """
    information, free = camera_knowledge(clip, settings)
    information = information / np.reshape(variance_factor, (-1, 1, 1))
    variance = (observed.noise * noise.scale) ** 2 * noise.correlation
    scale = settings.loss_scale / np.sqrt(noise.correlation)
    return Problem(
        cameras=clip.cameras,
        free=free & ~fixed[:, None],
        camera_information=information,
        points=observed.points,
        point_information=np.zeros(len(observed.points)),
        point_of=observed.point_of,
        camera_of=observed.camera_of,
        image=observed.image,
        weight=1.0 / variance,
        scale=np.full(len(variance), scale),
        names=clip.names,
    )


def estimate_variance_factor(problem: Problem, adjusted: Solution) -> Floats:
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
    blocks = adjusted.camera_covariance.reshape(count, SIZE, count, SIZE)
    own = blocks[np.arange(count), :, np.arange(count)]
    kept = np.einsum("cij,cji->c", problem.camera_information, own)
    told = np.maximum(problem.free.sum(axis=1) - kept, 0.0)
    # Use the median: a camera that shows other people must not free all the others.
    overall = float(np.median((squared + 1.0) / (told + 1.0)))
    return np.asarray((squared + weight * overall) / (told + weight))


def markings_problem(clip: Clip, fixed: Flags, settings: BundleAdjustmentSettings) -> Problem:
    """Return the adjustment of cameras to clicks alone, all parameters free, without a prior."""
    # In rad, m, 1, px, 1; a hundredth of it would already constrain the lens.
    spread = 100.0 * np.array([1.0] * 3 + [100.0] * 3 + [1.0, 300.0, 300.0, 3.0, 30.0, 300.0])
    clicked = [np.flatnonzero(clicks.inlier) for clicks in clip.clicks]
    points = [clicks.points_world[i] for clicks, i in zip(clip.clicks, clicked, strict=True)]
    image = [clicks.points_image[i] for clicks, i in zip(clip.clicks, clicked, strict=True)]
    world = np.concatenate(points)
    has = np.array([len(i) > 0 for i in clicked])
    return Problem(
        cameras=clip.cameras,
        free=np.repeat((has & ~fixed)[:, None], SIZE, axis=1),
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
    information = np.zeros_like(known)
    free: Flags = np.diagonal(known, axis1=1, axis2=2) > 0.0
    for c in range(len(known)):
        block = np.ix_(free[c], free[c])
        # Lens coefficients and meters differ by many powers of ten.
        size = np.sqrt(np.diag(known[c][block]))
        information[c][block] = np.linalg.inv(known[c][block] / np.outer(size, size)) / np.outer(
            size, size
        )
    return 0.5 * (information + information.swapaxes(1, 2)), free


def known_covariance(clip: Clip, settings: BundleAdjustmentSettings) -> Floats:
    """Return the prior covariance (cameras, 12, 12) of a step by the camera's source."""
    count = len(clip.covariance)
    distance = clip.distance
    usual = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 1.0
    distance = np.where(np.isfinite(distance), distance, usual)
    given = settings.given
    spread = np.zeros((count, SIZE))
    spread[:, :3] = given.rotation_rad
    spread[:, 3:6] = given.center * distance[:, None]
    spread[:, 6] = given.focal
    on_lines = np.zeros(count, dtype=np.bool_) if clip.on_lines is None else clip.on_lines
    factor = np.where(on_lines, settings.lines_uncertainty, settings.clicks_uncertainty)
    return np.where(
        clip.given[:, None, None],
        spread[:, :, None] ** 2 * np.eye(SIZE),
        factor[:, None, None] ** 2 * clip.covariance,
    )


def residuals(cameras: Camera, points: Floats, observed: Observations) -> Floats:
    """Return projected minus observed pixels (n, 2) of keypoints at points (points, 3) [m]."""
    off = np.empty_like(observed.image)
    for c in range(len(cameras.focal)):
        rows = observed.camera_of == c
        off[rows] = cameras[c].project(points[observed.point_of[rows]]) - observed.image[rows]
    return off


def keypoint_information(cameras: Camera, observed: Observations) -> Floats:
    """Return the information of keypoints on a step of each camera (cameras, 12, 12).

    The points are fixed, and the noise is as stated.
    """
    information = np.zeros((len(cameras.focal), SIZE, SIZE))
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
    off = residuals(cameras, points, observed) / observed.noise[:, None]
    views = np.bincount(observed.point_of, minlength=len(points))[observed.point_of]
    squared = (off**2).sum(axis=1) / (1.0 - 1.5 / np.maximum(views, 2))
    scale = (
        float(np.sqrt(np.median(squared[views > 2]) / MEDIAN_SQUARED)) if (views > 2).any() else 1.0
    )
    pull = off / (1.0 + (off**2).sum(axis=1) / (robust_scale * scale) ** 2)[:, None]
    series = (observed.camera_of * (observed.person_of.max() + 1) + observed.person_of) * 17
    _, series = np.unique(series + observed.joint_of, return_inverse=True)
    summed = np.stack([np.bincount(series, pull[:, axis]) for axis in range(2)])
    correlation = float((summed**2).sum() / (pull**2).sum())
    return KeypointNoise(scale, max(1.0, correlation))
