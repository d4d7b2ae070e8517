"""Cameras that contradict all others, detected before they can bias an adjustment.

Either the calibration of such a camera is wrong, which adjustment can correct after a
down-weighting of the calibration; or the camera shows other people than the other cameras under the
same ids, which adjustment cannot correct.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.bundle_adjustment.building import camera_knowledge, known_covariance
from worldpose.bundle_adjustment.clip import Clip, keypoints_of, predict
from worldpose.bundle_adjustment.held_out_validation import HeldOut, joints_without
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.solving import Adjusted, Problem, solve
from worldpose.errors import InputError
from worldpose.static_calibration import PARAMETERS
from worldpose.triangulation.calibration_errors import StatedErrors, stated_errors

Booleans = NDArray[np.bool_]

_SIZE: Final = len(PARAMETERS)
_MEDIAN: Final = 2.0 * np.log(2.0)
"""Median squared length of a standard Gaussian in two dimensions [1]."""
_LIMIT: Final = 4.0
"""Median squared error, over the stated variance of noise and calibration, from which the others'
people place a camera [1]: twice the stated error, as for one correct camera in thirty."""
_CONTRADICTS: Final = 9.0
"""Squared step to that place in stated standard deviations, per parameter, from which its
calibration is distrusted [1]: three of them in every direction."""
_DISBELIEF: Final = 16.0
"""Factor on the variances of a camera during this placement [1]: people outweigh the prior where
they carry information; elsewhere the camera stays."""
_SCALES: Final = (30.0, 3.0)
"""Scales of the loss, one after the other [standard deviations]: the first allows a far step."""
_SEEN: Final = 20
"""Minimum keypoints for a contradiction [1]: one person, hardly more than once."""


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Contradictions of cameras, found before adjustment.

    Attributes:
        doubt: (cameras,) factor on the variance that calibration states [1].
        offset: (cameras, 12) steps of contradicting cameras to their place by the others' people.
        stranger: (cameras,) bool, whether it shows other people.
    """

    doubt: Floats
    offset: Floats
    stranger: Booleans

    @classmethod
    def none(cls, count: int) -> Contradictions:
        """Return the result for cameras without contradictions."""
        return cls(np.ones(count), np.zeros((count, _SIZE)), np.zeros(count, dtype=np.bool_))


def find_contradictions(
    clip: Clip,
    frames: NDArray[np.int64],
    held: HeldOut,
    settings: BundleAdjustmentSettings,
) -> Contradictions:
    """Return the cameras that disagree with all others far beyond their stated errors.

    Args:
        clip: cameras and people.
        frames: (k,) indices of frames.
        held: errors of people in every camera against joints from the other cameras.
        settings: the prior of given cameras.
    """
    keypoints, confidence = clip.keypoints[frames], clip.confidence[frames]
    image, weight = keypoints_of(keypoints, confidence, clip.detection_index[frames])
    joints = clip.joints[frames]
    _, noise = predict(clip.cameras, joints, weight, clip.triangulation)
    known = known_covariance(clip, settings)
    stated = stated_errors(clip.cameras, joints, clip.triangulation, known)
    # Noise, and the error of the other cameras' joints in this image.
    place = noise**2 + (stated.scale**2 * _joint_variance(stated))[..., None]
    with np.errstate(invalid="ignore"):
        squared = held.error**2 / (place + stated.variance[..., None])
    found = Contradictions.none(len(known))
    information, free = camera_knowledge(clip, settings)
    for c in range(len(known)):
        told = np.isfinite(squared[:, c])
        if told.sum() < _SEEN or np.median(squared[:, c][told]) < _LIMIT * _MEDIAN:
            continue
        points = joints_without(clip, clip.cameras, c, frames)
        used = np.isfinite(points[..., 0]) & (weight[:, c] > 0.0)
        used &= np.isfinite(place[:, c])
        used &= np.isfinite(clip.cameras[c].project(points)).all(axis=-1)
        number = int(used.sum())
        if number < _SEEN:
            found.stranger[c] = True
            continue
        problem = Problem(
            cameras=clip.cameras[c : c + 1],
            free=free[c : c + 1],
            camera_information=information[c : c + 1] / _DISBELIEF,
            points=points[used],
            point_information=np.full(number, np.inf),
            point_of=np.arange(number),
            camera_of=np.zeros(number, dtype=np.int64),
            image=image[:, c][used],
            weight=1.0 / place[:, c][used],
            scale=np.full(number, np.inf),
        )
        placed = _placed(problem, settings)
        if placed is None:
            found.stranger[c] = True
            continue
        off = placed.cameras[0].project(problem.points) - problem.image
        left = float(np.median((off**2).sum(axis=1) * problem.weight))
        if left > _LIMIT * _MEDIAN:
            found.stranger[c] = True
            continue
        step = placed.offset[0]
        squared_step = float(step @ information[c] @ step) / int(free[c].sum())
        if squared_step > _CONTRADICTS:
            found.offset[c], found.doubt[c] = step, squared_step
    return found


def _placed(problem: Problem, settings: BundleAdjustmentSettings) -> Adjusted | None:
    """Return the camera fitted to these points; None if it cannot image all of them."""
    offset = None
    for scale in _SCALES:
        loss = np.full(len(problem.points), scale)
        try:
            placed = solve(replace(problem, scale=loss), settings.solver, offset, covariance=False)
        except InputError:
            return None
        offset = placed.offset
    return placed


def _joint_variance(stated: StatedErrors) -> Floats:
    """Return the joints' variance by the other calibrations (frames, cameras, persons) [m^2].

    Per axis: n views of equal variance leave 3 / (2 n) of it, each seeing two of three axes.
    """
    there = stated.scale > 0.0
    squared = np.where(there, stated.variance / np.where(there, stated.scale, 1.0) ** 2, 0.0)
    others = there.sum(axis=1, keepdims=True) - there
    total = squared.sum(axis=1, keepdims=True) - squared
    return np.asarray(1.5 * total / np.maximum(others, 1) ** 2)
