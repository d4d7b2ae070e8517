"""Initial cameras from homographies, and from a grid of plausible places in the stands."""

from __future__ import annotations

from itertools import pairwise, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.static_calibration.adjustment import Problem, row_of
from worldpose.static_calibration.homography import camera_of, homographies
from worldpose.static_calibration.settings import CameraPrior

_AGREES: Final = 0.012
"""Maximum inlier distance of a homography, in image widths [1]: distortion of a few percent at the
border and the crown's height."""
_AZIMUTHS: Final = 16
"""Directions of the grid about the centre spot [1]: 22 degrees apart, so that the fit converges."""
_FACTORS: Final = (-1.0, 0.3)
"""Heights and distances of the grid, in spreads from the middle [1]."""
_FOCALS: Final = (-1.0, 0.0, 1.0)
"""Focal lengths of the grid, in spreads from the middle [1]."""
_FOCAL_REACH: Final = 2.5
"""Maximum deviation of a homography's focal length, in spreads about the middle [1]."""


def from_homographies(
    problem: Problem, prior: CameraPrior, *, leave_out: bool
) -> NDArray[np.float64]:
    """Return cameras (b, 22) of the homographies from points and straight markings.

    Args:
        problem: evidence and image size.
        prior: the range of focal lengths.
        leave_out: also leave out each straight marking in turn: one name may be wrong.
    """
    evidence, width = problem.evidence, problem.image_size[0]
    spread = np.exp(_FOCAL_REACH * prior.focal_spread)
    focal_range = (prior.focal * width / spread, prior.focal * width * spread)
    pixels = np.concatenate([evidence.points_image, evidence.drawn_image])
    seen = np.median(pixels, axis=0)
    found = [
        camera_of(homography, problem.image_size, seen, focal_range)
        for homography in homographies(
            evidence, problem.image_size, _AGREES * width, leave_out=leave_out
        )
    ]
    rows = [row_of(camera) for camera in found if camera is not None]
    return np.array(rows).reshape(-1, 22)


def plausible_cameras(problem: Problem, prior: CameraPrior) -> NDArray[np.float64]:
    """Return level cameras (b, 22) all around the stadium, oriented towards the clicks.

    The mean of the clicked pixels shows the mean of the clicked points, or each of the places along
    the drawn markings in turn.

    Args:
        problem: evidence and image size.
        prior: heights, distances and focal lengths.
    """
    evidence = problem.evidence
    pixels = np.concatenate([evidence.points_image, evidence.drawn_image])
    height = prior.height * np.exp(np.array(_FACTORS) * prior.height_spread)
    distance = prior.distance * np.exp(np.array(_FACTORS) * prior.distance_spread)
    focal = problem.image_size[0] * prior.focal * np.exp(np.array(_FOCALS) * prior.focal_spread)
    azimuth = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    grid = np.array(list(product(azimuth, distance, height, focal, range(len(_aims(problem))))))
    centers = np.stack(
        [grid[:, 1] * np.cos(grid[:, 0]), grid[:, 1] * np.sin(grid[:, 0]), grid[:, 2]], axis=1
    )
    aims = _aims(problem)[grid[:, 4].astype(np.int64)]
    rows = np.zeros((len(grid), 22))
    rows[:, :2] = grid[:, 3:4]
    rows[:, 2:4] = problem.prior[2:4]
    rotation = _looking(centers, aims, pixels.mean(axis=0) - rows[:, 2:4], grid[:, 3])
    rows[:, 9:18] = rotation.reshape(-1, 9)
    rows[:, 18:21] = -np.einsum("bij,bj->bi", rotation, centers)
    rows[:, 21] = np.inf
    return rows


def _aims(problem: Problem) -> NDArray[np.float64]:
    """Return places (a, 3) [m], world, that the mean of the clicked pixels may show."""
    evidence = problem.evidence
    middles = [
        evidence.samples_world[first:stop].mean(axis=0) for first, stop in pairwise(evidence.bounds)
    ]
    together = np.concatenate([evidence.points_world, np.array(middles).reshape(-1, 3)])
    aims = [together.mean(axis=0)]
    if len(evidence.points) < 2:
        # The image may show only a part of a long line, and the clicks do not tell which.
        for first, stop in pairwise(evidence.bounds):
            inner = np.linspace(first, stop - 1, 7)[1:-1:2].astype(np.int64)
            aims.extend(evidence.samples_world[inner])
    unique: NDArray[np.float64] = np.unique(np.round(aims, -1), axis=0)
    return unique


def _looking(
    centers: NDArray[np.float64],
    aims: NDArray[np.float64],
    off: NDArray[np.float64],
    focal: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return rotations (b, 3, 3) of level cameras with `aims` at `off` [px] from the center."""
    forward = aims - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    # Pan and tilt by the angles between the mean of the clicks and the image center.
    tilt = np.arcsin(forward[:, 2]) + np.arctan(off[:, 1] / focal)
    pan = np.arctan2(forward[:, 1], forward[:, 0]) + np.arctan(off[:, 0] / focal)
    forward = np.stack(
        [np.cos(tilt) * np.cos(pan), np.cos(tilt) * np.sin(pan), np.sin(tilt)], axis=1
    )
    right = np.stack([np.sin(pan), -np.cos(pan), np.zeros_like(pan)], axis=1)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
