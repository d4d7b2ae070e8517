"""Cameras that contradict all others, found before they can drag them.

Either such a camera is not where its calibration says, which adjustment can mend once it does not
believe the calibration; or it shows other people than the other cameras do under the same ids,
which nothing mends.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.building import camera_knowledge, known_covariance
from worldpose.bundle_adjustment.clip import Clip, keypoints_of, predict
from worldpose.bundle_adjustment.held_out_validation import HeldOut, joints_without
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings
from worldpose.bundle_adjustment.solving import Adjusted, Problem, solve
from worldpose.errors import InputError
from worldpose.static_calibration import PARAMETERS
from worldpose.triangulation.calibration_errors import StatedErrors, stated_errors

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]

_SIZE: Final = len(PARAMETERS)
_MEDIAN: Final = 2.0 * np.log(2.0)
"""Median squared length of a standard Gaussian in two dimensions [1]."""
_LIMIT: Final = 4.0
"""Median squared error, over what noise and calibration state, from which a camera is placed by the
others' people [1]: twice as far off as it says, as one honest camera in thirty is."""
_CONTRADICTS: Final = 9.0
"""Squared step to there in stated standard deviations, per parameter, from which its calibration is
not believed [1]: three of them in every direction."""
_DISBELIEF: Final = 16.0
"""Factor on the variances of a camera while it is placed so [1]: what people tell exceeds it, what
they do not tell stays."""
_SCALES: Final = (30.0, 3.0)
"""Of the loss, one after the other [standard deviations]: first it must get there."""
_SEEN: Final = 20
"""Fewest keypoints that can contradict [1]: one person, hardly more than once."""


@dataclass(frozen=True, eq=False)
class Contradictions:
    """What is known of cameras before they are adjusted.

    Attributes:
        doubt: (cameras,) factor on the variance that calibration states [1].
        offset: (cameras, 12) steps to where the others' people put contradicting cameras.
        stranger: (cameras,) bool, does it show other people.
    """

    doubt: Floats
    offset: Floats
    stranger: Booleans

    @classmethod
    def none(cls, count: int) -> Contradictions:
        """Those of cameras that nothing speaks against."""
        return cls(np.ones(count), np.zeros((count, _SIZE)), np.zeros(count, dtype=np.bool_))


def find_contradictions(
    clip: Clip,
    frames: NDArray[np.int64],
    held: HeldOut,
    settings: BundleAdjustmentSettings,
) -> Contradictions:
    """Return which cameras disagree with all others far beyond what they state.

    Args:
        clip: cameras and people.
        frames: (k,) indices of frames.
        held: their errors in every camera with joints from the other cameras.
        settings: the prior of given cameras.
    """
    keypoints, confidence = clip.keypoints[frames], clip.confidence[frames]
    image, weight = keypoints_of(keypoints, confidence, clip.detection_index[frames])
    joints = clip.joints[frames]
    _, noise = predict(clip.cameras, joints, weight, clip.triangulation)
    known = known_covariance(clip, settings)
    stated = stated_errors(clip.cameras, joints, clip.triangulation, known)
    # What the others' joints may be off, as the camera sees it.
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
    """The camera where these points put it; None where none has them all in its picture."""
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
    """What calibrations of the other cameras do to their joints (frames, cameras, persons) [m^2].

    Per axis: n views of equal variance leave 3 / (2 n) of it, each seeing two of three axes.
    """
    there = stated.scale > 0.0
    squared = np.where(there, stated.variance / np.where(there, stated.scale, 1.0) ** 2, 0.0)
    others = there.sum(axis=1, keepdims=True) - there
    total = squared.sum(axis=1, keepdims=True) - squared
    return np.asarray(1.5 * total / np.maximum(others, 1) ** 2)
