"""Joint estimate by static cameras of the pitch of a venue.

Paint lies where it lies for every camera: the surface of the pitch, the errors of a survey, and
uneven ground and paint. Each camera alone cannot tell these from its own position and lens; two
cameras with other views of the same paint can. A camera's result therefore includes the Gaussian of
what all cameras share, and how the camera depends on it; the product of all cameras' Gaussians
gives the pitch of the venue, and each camera on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.arrays import Floats, Integers
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera, camera_from_arrays
from worldpose.pitch.template import Surface
from worldpose.static_calibration.curvature_correction import ClicksAndBars, weight_residuals
from worldpose.static_calibration.line_samples import FIRST_KNOT
from worldpose.static_calibration.parameters import CameraOnPitch, step_camera

SURFACE: Final = (-2_000_000_000, -2_000_000_001)
"""Numbers of the unknown crown and end fall."""
ARRAYS: Final = ("number", "prior_mean", "prior", "mean", "information", "response")


@dataclass(frozen=True, eq=False)
class VenueEvidence:
    """ClickEvidence of one camera about the unknowns of a venue.

    Attributes:
        number: (k,) numbers of the unknowns, see `ProjectedLines`, then `SURFACE`.
        prior_mean: (k,) [m].
        prior: (k, k) its information [1/m^2].
        mean: (k,) after this camera's evidence and the prior [m].
        information: (k, k) information of this camera's evidence alone [1/m^2].
        response: (12, k) step of the camera per change of the unknowns.
    """

    number: Integers
    prior_mean: Floats
    prior: Floats
    mean: Floats
    information: Floats
    response: Floats

    @property
    def covariance(self) -> Floats:
        """(k, k) after this camera's evidence and the prior [m^2]."""
        return _invert(self.information + self.prior)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the stored arrays by name."""
        return {f"venue_{name}": getattr(self, name) for name in ARRAYS}

    @classmethod
    def from_arrays(cls, arrays: Mapping[Any, ArrayLike]) -> VenueEvidence | None:
        """Return the evidence of a stored camera; None if it was not refined on lines."""
        if f"venue_{ARRAYS[0]}" not in arrays:
            return None
        return cls(**{name: np.asarray(arrays[f"venue_{name}"]) for name in ARRAYS})


def gather_venue_evidence(evidence: ClicksAndBars, best: CameraOnPitch) -> VenueEvidence:
    """Return what a camera refined on painted lines tells about the venue."""
    bars, free = evidence.bars, np.flatnonzero(evidence.problem.free)
    there = evidence.problem.evidence.on_surface(best.surface)
    problem = replace(evidence.problem, evidence=there)
    clicks, by_clicks = weight_residuals(
        problem, best.camera.numbers, evidence.scale, evidence.surface
    )
    lines, by_lines = bars.whiten_raw(best.camera, best.surface)
    numbers, index = np.unique(bars.unknowns, return_inverse=True)
    paint = np.zeros((len(lines), len(numbers)))
    rows = np.arange(len(lines))[:, None]
    np.add.at(
        paint, (rows, index.reshape(bars.unknowns.shape)), bars.by_paint / bars.noise[:, None]
    )
    shared = (numbers >= 0) | (numbers <= FIRST_KNOT)
    shared_std = np.where(numbers >= 0, bars.paint.points_m, bars.paint.unevenness_m)[shared]
    # The last residuals of the clicks are the surface's prior, which all cameras share.
    clicks, by_clicks = clicks[:-2], by_clicks[:-2]
    click_rows = len(clicks)
    own = np.concatenate(
        [
            np.concatenate([by_clicks[:, free], np.zeros((click_rows, (~shared).sum()))], axis=1),
            np.concatenate([by_lines[:, free], paint[:, ~shared]], axis=1),
        ]
    )
    common = np.concatenate(
        [
            np.concatenate([np.zeros((click_rows, len(shared_std))), by_clicks[:, STEP:]], axis=1),
            np.concatenate([paint[:, shared] / shared_std, by_lines[:, STEP:]], axis=1),
        ]
    )
    residuals = np.concatenate([clicks, lines])
    own_prior = np.concatenate([np.zeros(len(free)), np.ones(int((~shared).sum()))])
    inner = own.T @ own + np.diag(own_prior)
    cross = own.T @ common
    answer = _solve(inner, np.column_stack([cross, own.T @ residuals]))
    information = common.T @ common - cross.T @ answer[:, :-1]
    prior = np.zeros_like(information)
    prior[np.arange(len(shared_std)), np.arange(len(shared_std))] = shared_std**-2.0
    prior[-2:, -2:] = np.linalg.inv(evidence.surface.covariance)
    prior_mean = np.concatenate([np.zeros(len(shared_std)), evidence.surface.shape])
    start = np.concatenate([np.zeros(len(shared_std)), best.surface])
    right = prior @ (prior_mean - start)
    right -= common.T @ residuals - cross.T @ answer[:, -1]
    response = np.zeros((STEP, len(start)))
    response[free] = -answer[: len(free), :-1]
    return VenueEvidence(
        number=np.concatenate([numbers[shared], SURFACE]).astype(np.int64),
        prior_mean=prior_mean,
        prior=prior,
        mean=start + _solve(information + prior, right),
        information=0.5 * (information + information.T),
        response=response,
    )


@dataclass(frozen=True, eq=False)
class Venue:
    """The static cameras of a venue on their common pitch.

    Attributes:
        cameras: batch (cameras,).
        covariance: (cameras, 12, 12) covariance of a step of each; NaN for a given camera.
        surface: surface of the pitch; None if no camera was refined on lines.
    """

    cameras: Camera
    covariance: Floats
    surface: Surface | None


def join_cameras(calibrations: Sequence[Mapping[Any, ArrayLike]]) -> Venue:
    """Return stored calibrations on the pitch that all of them show."""
    cameras = [camera_from_arrays(each) for each in calibrations]
    unknown = np.full((STEP, STEP), np.nan)
    covariance = np.array([np.asarray(each.get("covariance", unknown)) for each in calibrations])
    evidence = [VenueEvidence.from_arrays(each) for each in calibrations]
    told = [each for each in evidence if each is not None]
    if not told:
        return Venue(Camera.stack(cameras), covariance, None)
    numbers = np.unique(np.concatenate([each.number for each in told]))
    count = len(numbers)
    prior, times = np.zeros((count, count)), np.zeros((count, count))
    mean, information = np.zeros(count), np.zeros((count, count))
    right = np.zeros(count)
    for each in told:
        at = np.searchsorted(numbers, each.number)
        block = np.ix_(at, at)
        prior[block] += each.prior
        times[block] += 1.0
        mean[at] = each.prior_mean
        information[block] += each.information
        # Information of the evidence alone about the unknowns.
        right[at] += each.information @ each.mean + each.prior @ (each.mean - each.prior_mean)
    prior /= np.maximum(times, 1.0)
    total = information + prior
    pooled, spread = _solve(total, right + prior @ mean), _invert(total)
    for index, one in enumerate(evidence):
        if one is None:
            continue
        at = np.searchsorted(numbers, one.number)
        cameras[index] = step_camera(cameras[index], one.response @ (pooled[at] - one.mean))
        change = spread[np.ix_(at, at)] - one.covariance
        covariance[index] += one.response @ change @ one.response.T
    at = np.array([int(np.flatnonzero(numbers == each)[0]) for each in SURFACE])
    shape, certain = pooled[at], spread[np.ix_(at, at)]
    return Venue(Camera.stack(cameras), covariance, Surface(shape, certain))


def _solve(matrix: Floats, right: Floats) -> Floats:
    """Solve a positive definite system whose unknowns have different scales."""
    size = np.sqrt(np.diag(matrix))
    scaled = matrix / np.outer(size, size)
    inner = np.linalg.solve(scaled, right / (size if right.ndim == 1 else size[:, None]))
    return np.asarray(inner / (size if right.ndim == 1 else size[:, None]))


def _invert(matrix: Floats) -> Floats:
    return _solve(matrix, np.eye(len(matrix)))
