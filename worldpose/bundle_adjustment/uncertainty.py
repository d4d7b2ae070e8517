"""Effect of survey errors on all cameras together.

Cameras calibrated on the same painted lines share the errors of the survey of these lines. Each
camera's covariance includes them, but averaging over sixteen cameras does not reduce them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.bundle_adjustment.clip import Clip
from worldpose.geometry import Camera
from worldpose.static_calibration import PARAMETERS, project_with_jacobian
from worldpose.static_calibration.line_samples import project_lines, sample_markings, thin_samples
from worldpose.static_calibration.settings import LineRefinementSettings

_SPACING: Final = 0.25
"""Spacing of samples along painted lines [m]."""
_LINE_WIDTH: Final = LineRefinementSettings().line_width
_APART: Final = 8.0
"""Minimum distance of two independent samples in an image [px]: the width of a bar across a
line."""
_MOST: Final = 700
"""Samples per image, approximately [1]."""
_NOISE: Final = 0.1
"""Standard deviation of a sample across its line [px]. With it, and the true errors of a survey,
the response predicts the displacement of people by all cameras to 0.6 of 6 mm on simulated matches;
0.3 predicts two thirds of it, 0.03 the same."""
_SHIFT: Final = LineRefinementSettings().line_shift
"""Standard deviation of the shift of a whole line in one image [px]; no other camera shares it."""


def survey_response(clip: Clip, survey_error: float) -> Floats:
    """Return the response (cameras, 12, unknowns) of calibrated cameras to survey errors.

    The error of a calibration with unknowns s of unit variance is C H (K + 1)^-1 s, where C is its
    covariance, and H and K are the blocks of lines in its normal equations, for camera and
    unknowns, and for the unknowns alone. Unknowns are the positions of the template's points, which
    cameras share, and a shift of each marking in the image, which each camera has on its own. The
    lines are those that the camera sees. Clicks are left out, because their errors are far larger
    than those of the survey.

    Args:
        clip: cameras, their covariance, the pitch, and the cameras calibrated on its lines.
        survey_error: standard deviation of the template's points along each axis [m].

    Returns:
        Zero for cameras not calibrated on lines; no unknowns without a pitch, else three per point
        of the template.
    """
    count = len(clip.covariance)
    if clip.pitch is None or clip.on_lines is None or not clip.on_lines.any():
        return np.zeros((count, clip.covariance.shape[1], 0))
    samples = sample_markings(clip.pitch, _SPACING)
    response = np.zeros((count, clip.covariance.shape[1], 3 * len(clip.pitch.points)))
    for c in np.flatnonzero(clip.on_lines).tolist():
        seen = project_lines(clip.cameras[c], samples, _LINE_WIDTH, survey_error, _SHIFT)
        seen = seen[thin_samples(seen, samples, _APART, _MOST)]
        unknowns, column = np.unique(seen.unknowns, return_inverse=True)
        by_paint = np.zeros((len(seen.places), len(unknowns)))
        np.add.at(by_paint, (np.arange(len(by_paint))[:, None], column), seen.by_paint / _NOISE)
        known = by_paint.T @ by_paint + np.eye(len(unknowns))
        met = by_paint.T @ seen.by_camera / _NOISE
        moved = clip.covariance[c] @ np.linalg.solve(known, met).T
        response[c][:, unknowns[unknowns >= 0]] = moved[:, unknowns >= 0]
        response[c] /= max(1.0, _explained_share(clip.covariance[c], response[c]))
    return response


def add_shared_errors(covariance: Floats, information: Floats, response: Floats) -> Floats:
    """Return the covariance (cameras, 12, 12) of each camera for correlated calibrations.

    The weights of the adjustment treat calibrations as independent; its errors follow from their
    correlation (the sandwich of White 1980).

    Args:
        covariance: (12 cameras, 12 cameras) of the adjustment with independent calibrations.
        information: (cameras, 12, 12) of the calibrations in the adjustment.
        response: (cameras, 12, unknowns) of each calibration to the shared unknowns.
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


_DISTANCE: Final = 60.0
"""Distance of the points whose image motion makes parameters comparable [m]."""
_NAMED: Final = 0.25
"""Share of the largest component from which a parameter is named [1]."""


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
    """Return the direction of largest variance.

    Parameters are scaled by the image motion of each alone; along a weak direction these motions
    cancel.

    Args:
        camera: a single camera.
        covariance: (12, 12) of a step.
    """
    width, height = camera.image_size
    across, down = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 6))
    rays = camera.unproject(np.stack([across, down], axis=-1).reshape(-1, 2))
    seen = rays.origins + _DISTANCE * rays.directions
    _, by_step = project_with_jacobian(camera, seen[np.isfinite(seen).all(axis=1)])
    pixels = np.sqrt(np.nanmean((by_step**2).sum(axis=1), axis=0))
    values, vectors = np.linalg.eigh(covariance * np.outer(pixels, pixels))
    step = np.sqrt(max(values[-1], 0.0)) * vectors[:, -1] / pixels
    if not step.any():
        return WeakDirection(step, "not known")
    moved = np.abs(vectors[:, -1])
    named = np.flatnonzero(moved > _NAMED * moved.max())
    named = named[np.argsort(-moved[named], kind="stable")]
    parts = [f"{PARAMETERS[k]} {step[k]:+.2g}{_UNITS[k]}" for k in named]
    return WeakDirection(step, ", ".join(parts))


_UNITS: Final = (" rad",) * 3 + (" m",) * 3 + ("", " px", " px", "", "", "")
