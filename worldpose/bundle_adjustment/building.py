"""Bundle adjustment problems from people and from markings (B2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.clip import Clip, Observed
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.solving import Adjusted, Problem, SolverSettings
from worldpose.static_calibration import PARAMETERS

_SIZE: Final = len(PARAMETERS)
_UNKNOWN: Final = 100.0 * np.array([1.0] * 3 + [100.0] * 3 + [1.0, 300.0, 300.0, 3.0, 30.0, 300.0])
"""Standard deviations of an uninformative prior [rad, m, 1, px, 1]; they only keep the system
regular. A hundredth of them would already constrain the lens."""
MARKINGS_SOLVER: Final = SolverSettings(iterations=500, cost_change=1e-6)
"""For ill-conditioned directions as long and flat as those of a lens determined by six clicks."""


_FAITH: Final = 10.0
"""Weight of the median over all cameras, in directions [1]: as many as one camera has."""


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
    observed: Observed,
    noise: KeypointNoise,
    standing: NDArray[np.bool_],
    settings: BundleAdjustmentSettings,
    doubt: NDArray[np.float64] | float = 1.0,
) -> Problem:
    """Return the adjustment of cameras to people, with calibration as the prior.

    Clicks, painted lines and priors enter as the Gaussian posterior of calibration, people as free
    points under Cauchy's loss. The correlation divides an observation's weight, so that twenty
    frames with the same detector error count as few.

    Args:
        clip: cameras with their covariance.
        observed: keypoints.
        noise: their scale and correlation.
        standing: (cameras,) bool, fixed cameras.
        settings: robust scale, and the prior of given cameras.
        doubt: (cameras,) factor on the variance that calibration states [1].
    """
    information, free = camera_knowledge(clip, settings)
    information = information / np.reshape(doubt, (-1, 1, 1))
    variance = (observed.noise * noise.scale) ** 2 * noise.correlation
    scale = settings.robust_scale / np.sqrt(noise.correlation)
    return Problem(
        cameras=clip.cameras,
        free=free & ~standing[:, None],
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


def measured_doubt(problem: Problem, adjusted: Adjusted) -> NDArray[np.float64]:
    """Return the factor (cameras,) on calibration's variances, estimated from an adjustment.

    People move a camera in the directions that they determine; where its step is longer than its
    calibration allows, the calibration was overconfident. The squared step in stated standard
    deviations is divided by the number of these directions (MacKay 1992), shrunk towards the median
    of all cameras.

    Args:
        problem: the solved problem, with the variances that the factor multiplies.
        adjusted: its solution.
    """
    count = len(problem.free)
    step = adjusted.offset
    squared = np.einsum("ci,cij,cj->c", step, problem.camera_information, step)
    blocks = adjusted.camera_covariance.reshape(count, _SIZE, count, _SIZE)
    own = blocks[np.arange(count), :, np.arange(count)]
    kept = np.einsum("cij,cji->c", problem.camera_information, own)
    told = np.maximum(problem.free.sum(axis=1) - kept, 0.0)
    # Use the median: a camera that shows other people must not free all the others.
    overall = float(np.median((squared + 1.0) / (told + 1.0)))
    return np.asarray((squared + _FAITH * overall) / (told + _FAITH))


def markings_problem(
    clip: Clip, standing: NDArray[np.bool_], settings: BundleAdjustmentSettings
) -> Problem:
    """Return the adjustment of cameras to clicks alone, all parameters free, no prior (trap 1).

    Args:
        clip: cameras and clicks.
        standing: (cameras,) bool, fixed cameras.
        settings: noise of clicks.
    """
    clicked = [np.flatnonzero(clicks.inlier) for clicks in clip.clicks]
    points = [clicks.points_world[i] for clicks, i in zip(clip.clicks, clicked, strict=True)]
    image = [clicks.points_image[i] for clicks, i in zip(clip.clicks, clicked, strict=True)]
    world = np.concatenate(points)
    has = np.array([len(i) > 0 for i in clicked])
    return Problem(
        cameras=clip.cameras,
        free=np.repeat((has & ~standing)[:, None], _SIZE, axis=1),
        camera_information=np.tile(np.diag(_UNKNOWN**-2.0), (len(has), 1, 1)),
        points=world,
        point_information=np.full(len(world), np.inf),
        point_of=np.arange(len(world)),
        camera_of=np.repeat(np.arange(len(has)), [len(i) for i in clicked]),
        image=np.concatenate(image),
        weight=np.full(len(world), settings.click_noise**-2.0),
        scale=np.full(len(world), np.inf),
        names=clip.names,
    )


def camera_knowledge(
    clip: Clip, settings: BundleAdjustmentSettings
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the prior information (cameras, 12, 12) on a step, and free parameters (cameras, 12).

    Args:
        clip: cameras with their covariance.
        settings: the prior of given cameras.
    """
    known = known_covariance(clip, settings)
    information = np.zeros_like(known)
    free: NDArray[np.bool_] = np.diagonal(known, axis1=1, axis2=2) > 0.0
    for c in range(len(known)):
        block = np.ix_(free[c], free[c])
        # Lens coefficients and meters differ by many powers of ten.
        size = np.sqrt(np.diag(known[c][block]))
        information[c][block] = np.linalg.inv(known[c][block] / np.outer(size, size)) / np.outer(
            size, size
        )
    return 0.5 * (information + information.swapaxes(1, 2)), free


def known_covariance(clip: Clip, settings: BundleAdjustmentSettings) -> NDArray[np.float64]:
    """Return the prior covariance (cameras, 12, 12) of a step by the camera's source.

    Args:
        clip: cameras; the prior of given ones scales with their distance to people.
        settings: that prior, and factors on the stated deviations of calibration.
    """
    count = len(clip.covariance)
    distance = clip.distance
    usual = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 1.0
    distance = np.where(np.isfinite(distance), distance, usual)
    given = settings.given
    spread = np.zeros((count, _SIZE))
    spread[:, :3] = given.rotation
    spread[:, 3:6] = given.center * distance[:, None]
    spread[:, 6] = given.focal
    on_lines = np.zeros(count, dtype=np.bool_) if clip.on_lines is None else clip.on_lines
    factor = np.where(on_lines, settings.lines_uncertainty, settings.clicks_uncertainty)
    return np.where(
        clip.given[:, None, None],
        spread[:, :, None] ** 2 * np.eye(_SIZE),
        factor[:, None, None] ** 2 * clip.covariance,
    )
