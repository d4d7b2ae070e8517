"""Uncertainty that neither keypoints nor averaging over cameras can reduce: gauge and survey.

Gauge freedom is a similarity transform of all cameras and people, which no keypoint observes. If no
camera was calibrated on markings, only the given cameras define position, orientation and scale of
the world. Adjustment must not change them.

Cameras calibrated on the same painted lines share the errors of the survey of these lines. Each
camera's covariance includes them, but averaging over sixteen cameras does not reduce them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.bundle_adjustment.clip import Clip
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.covariance import invert_free
from worldpose.geometry.optimize.losses import cauchy_weight
from worldpose.geometry.rigid import Similarity, align
from worldpose.static_calibration.line_samples import (
    EXACT_PAINT,
    project_lines,
    sample_markings,
    thin_samples,
)
from worldpose.static_calibration.parameters import PARAMETERS, project_with_jacobian
from worldpose.static_calibration.settings import LineRefinementSettings

SIMILARITY: Final = 7
"""Degrees of freedom: translation, rotation, scale."""


def align_points(points: Floats, targets: Floats) -> Similarity:
    """Return the similarity transform that brings points (n, 3) [m] to their targets (n, 3) [m].

    The weight of a pair depends on its distance over the median distance (Cauchy's weight), so that
    a person or a joint that really moved has little influence. The result is the identity for fewer
    than three pairs, or for pairs on one line.
    """
    found = Similarity(np.array(1.0), np.eye(3), np.zeros(3))
    if len(points) < 3:
        return found
    off = [np.linalg.svd(each - each.mean(axis=0), compute_uv=False) for each in (points, targets)]
    if any(values[1] <= 1e-4 * values[0] for values in off):
        return found
    weight = np.ones(len(points))
    # The last ones change less than a micrometre.
    for _ in range(10):
        found = align(points, targets, with_scale=True, weights=weight)
        distance = np.linalg.norm(found.apply(points) - targets, axis=1)
        weight = cauchy_weight(distance**2, max(float(np.median(distance)), 1e-9))
    return found


def similarity_steps(cameras: Camera, origin: Floats) -> Floats:
    """Return the steps (cameras, 12, 7) of cameras that follow a similarity transform.

    Its parameters are a translation [m], a rotation about the origin (3,) [rad] and the logarithm
    of a scale about it; steps are in the order of `PARAMETERS`.
    """
    pose = cameras.cam_from_world
    steps = np.zeros((len(pose.rotation), 12, SIMILARITY))
    there = pose.rotation @ origin + pose.translation
    steps[:, 3:6, :3] = -pose.rotation
    steps[:, :3, 3:6] = -pose.rotation
    # A rotation by R theta about the point at `there` in the camera's frame.
    cross = np.cross(np.eye(3), there[:, None, :])
    steps[:, 3:6, 3:6] = cross.swapaxes(1, 2) @ pose.rotation
    steps[:, 3:6, 6] = there
    return steps


def relative_covariance(
    covariance: Floats, cameras: Camera, information: Floats, origin: Floats
) -> tuple[Floats, Floats]:
    """Split the covariance of cameras (12 cameras, 12 cameras) into individual and common errors.

    The common part is the similarity transform that best explains the cameras' errors as pixels at
    the people, whose position is `origin` (3,) [m], world; the rest is relative. A camera's weight
    is the information of keypoints on it alone (cameras, 12, 12). Returned are (cameras, 12, 12) of
    each relative step, and (7, 7) of the transform's parameters as in `similarity_steps`.
    """
    count, size = information.shape[:2]
    steps = similarity_steps(cameras, origin)
    weighted = information @ steps
    normal = np.einsum("cij,cik->jk", steps, weighted)
    common_of = (
        invert_free(normal, np.ones(len(normal), np.bool_))
        @ weighted.reshape(count * size, SIMILARITY).T
    )
    flat = steps.reshape(count * size, SIMILARITY)
    keep = np.eye(count * size) - flat @ common_of
    relative = (keep @ covariance @ keep.T).reshape(count, size, count, size)
    own = relative[np.arange(count), :, np.arange(count)]
    common = common_of @ covariance @ common_of.T
    return 0.5 * (own + own.swapaxes(1, 2)), 0.5 * (common + common.T)


def survey_response(clip: Clip, survey_error: float) -> Floats:
    """Return the response (cameras, 12, unknowns) of calibrated cameras to survey errors.

    The error of a calibration with unknowns s of unit variance is C H (K + 1)^-1 s, where C is its
    covariance, and H and K are the blocks of lines in its normal equations, for camera and
    unknowns, and for the unknowns alone. Unknowns are the positions of the template's points, which
    cameras share, and a shift of each marking in the image, which each camera has on its own. The
    lines are those that the camera sees. Clicks are left out, because their errors are far larger
    than those of the survey, a deviation of the template's points along each axis [m].

    The response is zero for cameras not calibrated on lines. Without a pitch there are no unknowns,
    else three per point of the template.
    """
    # This noise predicts the displacement of people by all cameras to 0.6 of 6 mm in simulation.
    noise_px = 0.1
    count = len(clip.covariance)
    if clip.pitch is None or clip.on_lines is None or not clip.on_lines.any():
        return np.zeros((count, clip.covariance.shape[1], 0))
    samples = sample_markings(clip.pitch, 0.25)
    noise = replace(
        EXACT_PAINT, points_m=survey_error, shift_px=LineRefinementSettings().line_shift_px
    )
    response = np.zeros((count, clip.covariance.shape[1], 3 * len(clip.pitch.points)))
    for c in np.flatnonzero(clip.on_lines).tolist():
        seen = project_lines(clip.cameras[c], samples, LineRefinementSettings().line_width_m, noise)
        # Independent samples are as far apart as the width of a bar across a line.
        seen = seen[thin_samples(seen, samples, 8.0, 700)]
        unknowns, column = np.unique(seen.unknowns, return_inverse=True)
        by_paint = np.zeros((len(seen.places), len(unknowns)))
        np.add.at(by_paint, (np.arange(len(by_paint))[:, None], column), seen.by_paint / noise_px)
        known = by_paint.T @ by_paint + np.eye(len(unknowns))
        met = by_paint.T @ seen.by_camera[:, :-2] / noise_px
        moved = clip.covariance[c] @ np.linalg.solve(known, met).T
        response[c][:, unknowns[unknowns >= 0]] = moved[:, unknowns >= 0]
        response[c] /= max(1.0, _explained_share(clip.covariance[c], response[c]))
    return response


def add_shared_errors(covariance: Floats, information: Floats, response: Floats) -> Floats:
    """Return the covariance (cameras, 12, 12) of each camera for correlated calibrations.

    The weights of the adjustment treat calibrations as independent, with covariance (12 cameras, 12
    cameras); its errors follow from their correlation (the sandwich of White 1980). `information`
    (cameras, 12, 12) is that of the calibrations in the adjustment, and `response` (cameras, 12,
    unknowns) that of each calibration to the shared unknowns.
    """
    count, size = information.shape[:2]
    blocks = covariance.reshape(count, size, count, size)
    own = blocks[np.arange(count), :, np.arange(count)]
    pull = np.einsum("cij,cjk->cik", information, response)
    moved = np.einsum("cidj,djk->cdik", blocks, pull)
    together = moved.sum(axis=1)
    # The covariance already has the contribution of each camera to itself.
    alone = np.einsum("cdik,cdjk->cij", moved, moved)
    return np.asarray(own + together @ together.swapaxes(1, 2) - alone)


def _explained_share(covariance: Floats, response: Floats) -> float:
    """Return the largest share of a camera's standard deviation that a response explains."""
    free = np.diag(covariance) > 0.0
    size = np.sqrt(np.diag(covariance)[free])
    factor = np.linalg.cholesky(covariance[np.ix_(free, free)] / np.outer(size, size))
    return float(np.linalg.norm(np.linalg.solve(factor, response[free] / size[:, None]), ord=2))


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """Direction in which people and markings constrain a camera least.

    Attributes:
        step: (12,) one standard deviation along it, in the units of `PARAMETERS`.
        about: parameters that move together, with their steps.
    """

    step: Floats
    about: str


def weak_direction(camera: Camera, covariance: Floats) -> WeakDirection:
    """Return the direction of largest variance of a single camera's step.

    Parameters are scaled by the image motion of each alone; along a weak direction these motions
    cancel.
    """
    units = (" rad",) * 3 + (" m",) * 3 + ("", " px", " px", "", "", "")
    width, height = camera.image_size
    across, down = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 6))
    rays = camera.unproject(np.stack([across, down], axis=-1).reshape(-1, 2))
    seen = rays.origins + 60.0 * rays.directions
    _, by_step = project_with_jacobian(camera, seen[np.isfinite(seen).all(axis=1)])
    pixels = np.sqrt(np.nanmean((by_step**2).sum(axis=1), axis=0))
    values, vectors = np.linalg.eigh(covariance * np.outer(pixels, pixels))
    step = np.sqrt(max(values[-1], 0.0)) * vectors[:, -1] / pixels
    if not step.any():
        return WeakDirection(step, "not known")
    moved = np.abs(vectors[:, -1])
    named = np.flatnonzero(moved > 0.25 * moved.max())
    named = named[np.argsort(-moved[named], kind="stable")]
    parts = [f"{PARAMETERS[k]} {step[k]:+.2g}{units[k]}" for k in named]
    return WeakDirection(step, ", ".join(parts))
