"""Held-out validation: people outside the adjustment validate every camera's change."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.clip import Clip, project_joints
from worldpose.bundle_adjustment.residuals import (
    AdjustmentProblem,
    AdjustmentSolution,
    camera_knowledge,
    known_covariance,
)
from worldpose.bundle_adjustment.settings import CHANCE, BundleAdjustmentSettings
from worldpose.bundle_adjustment.solver import solve
from worldpose.bundle_adjustment.uncertainty import align_points
from worldpose.compiled import map_in_threads
from worldpose.errors import InputError
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import MEDIAN_SQUARED, cauchy_loss
from worldpose.triangulation.estimate import triangulate_frames
from worldpose.triangulation.person_offsets import StatedErrors, stated_errors


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors of held-out people's keypoints in every camera.

    Each joint is triangulated from the other cameras alone.

    Attributes:
        loss: (frames, cameras, persons, 17) Cauchy's loss [1]; NaN without data.
        error: (frames, cameras, persons, 17) length [px].
        joints: (frames, persons, 17, 3) [m], world, from all cameras; NaN without data.
    """

    loss: Floats
    error: Floats
    joints: Floats


def held_out_errors(
    clip: Clip, cameras: Camera, frames: Integers, people: Flags, robust_scale: float
) -> HeldOutErrors:
    """Return the errors of held-out people's keypoints against joints from the other cameras.

    The people (k, persons) are those held out in each of the frames (k,); the loss is Cauchy's at a
    scale [standard deviations].
    """
    detections = clip.detections[frames]
    index = np.where(people[:, None], detections.detection_index, -1).astype(np.int16)
    loss = np.full((*index.shape, detections.confidence.shape[-1]), np.nan)
    error = loss.copy()
    judges = np.flatnonzero(people.any(axis=0))
    judged = detections.assign_people(index[:, :, judges])
    image, weight = judged.by_person()

    def measure(c: int) -> tuple[Floats, Floats]:
        joints = _triangulate(clip, cameras, c, judged)
        predicted, noise = project_joints(
            cameras[c : c + 1], joints, weight[:, c : c + 1], clip.triangulation
        )
        length = np.linalg.norm(predicted[:, 0] - image[:, c], axis=-1)
        squared = (length / noise[:, 0]) ** 2
        return length, cauchy_loss(squared, robust_scale)

    for c, measured in enumerate(map_in_threads(measure, range(len(cameras.focal)))):
        error[:, c, judges], loss[:, c, judges] = measured
    loss[~np.isfinite(error)] = np.nan
    joints = np.full((len(frames), index.shape[2], *loss.shape[3:], 3), np.nan)
    joints[:, judges] = _triangulate(clip, cameras, None, judged)
    return HeldOutErrors(loss, error, joints)


def _triangulate(
    clip: Clip, cameras: Camera, camera: int | None, detections: KeypointDetections
) -> Floats:
    """Return joints (k, persons, 17, 3) [m], world, triangulated without one camera, if any."""
    others = detections.detection_index.copy()
    if camera is not None:
        others[:, camera] = -1
    return triangulate_frames(cameras, detections.assign_people(others), clip.triangulation).joints


@dataclass(frozen=True, eq=False)
class Verdict:
    """Held-out errors before and after a change, over the keypoints valid in both.

    Attributes:
        judges: (cameras,) number of these keypoints [1].
        loss: (cameras, 2) mean of Cauchy's loss before and after [1]; NaN without keypoints.
        error: (cameras, 2) median length before and after [px]; NaN without keypoints.
        significance: (cameras,) decrease of the loss over its standard error [1]; 0 if unknown.
    """

    judges: Integers
    loss: Floats
    error: Floats
    significance: Floats


def compare_errors(before: HeldOutErrors, after: HeldOutErrors) -> Verdict:
    """Return the comparison per camera."""
    count = before.loss.shape[1]
    both = np.isfinite(before.loss) & np.isfinite(after.loss)
    judges = both.sum(axis=(0, 2, 3))
    loss, error = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    for c in np.flatnonzero(judges):
        for side, held in enumerate((before, after)):
            loss[c, side] = held.loss[:, c][both[:, c]].mean()
            error[c, side] = np.median(held.error[:, c][both[:, c]])
    fall = before.loss - after.loss
    significance = np.array([_significance(fall[:, c]) for c in range(count)])
    return Verdict(judges, loss, error, significance)


def judge_cameras(verdict: Verdict, alone: Flags, min_judges: int) -> tuple[Flags, Flags]:
    """Return the cameras whose change is confirmed, and those that need none.

    Well calibrated cameras move by hundredths of a pixel, and their loss falls or rises by chance.
    A camera that is judged alone is confirmed only beyond that; within it, it agrees with the
    others as it is. Other cameras are confirmed unless their loss rises, and never found to agree.
    """
    enough = verdict.judges >= min_judges
    with np.errstate(invalid="ignore"):
        falls = verdict.loss[:, 1] <= verdict.loss[:, 0]
    confirmed = enough & falls & (~alone | (verdict.significance >= CHANCE))
    return confirmed, enough & alone & (np.abs(verdict.significance) < CHANCE)


def _significance(fall: Floats) -> float:
    """Return the mean decrease of the loss over its standard error [1]; 0 if unknown."""
    intervals = 4  # errors of a person in one interval count as one observation
    told = np.isfinite(fall)
    part = np.arange(len(fall)) * intervals // max(len(fall), 1)
    groups = []
    for person in range(fall.shape[-2]):
        for each in range(intervals):
            inside = fall[part == each, ..., person, :][told[part == each, ..., person, :]]
            if len(inside):
                groups.append(float(inside.mean()))
    if len(groups) < 2:
        return 0.0
    error = float(np.std(groups, ddof=1) / np.sqrt(len(groups)))
    return float(np.mean(groups)) / max(error, 1e-12)


@dataclass(frozen=True)
class PooledEvidence:
    """Result of all held-out people together for a change of all cameras.

    Attributes:
        gain: relative decrease of the loss [1]; negative if it rises.
        significance: decrease of the loss over its standard error [1].
        shift: common shift of people [m].
    """

    gain: float
    significance: float
    shift: float


def pool_evidence(before: HeldOutErrors, after: HeldOutErrors, cameras: Flags) -> PooledEvidence:
    """Return the result of all held-out people together, in the images of some cameras."""
    fall = (before.loss - after.loss)[:, cameras]
    told = np.isfinite(fall)
    gain = 0.0
    if told.any():
        gain = float(fall[told].sum() / max(before.loss[:, cameras][told].sum(), 1e-12))
    both = np.isfinite(before.joints).all(axis=-1) & np.isfinite(after.joints).all(axis=-1)
    moved = align_points(before.joints[both], after.joints[both])
    shift = 0.0
    if both.any():
        center = before.joints[both].mean(axis=0, keepdims=True)
        shift = float(np.linalg.norm(moved.apply(center) - center))
    return PooledEvidence(gain, _significance(fall), shift)


@dataclass(frozen=True, eq=False)
class Contradictions:
    """Contradictions of cameras, found before adjustment.

    Attributes:
        variance_factor: (cameras,) factor on the variance that calibration states [1].
        offset: (cameras, 12) steps of contradicting cameras to their place by the others' people.
        other_people: (cameras,) bool, whether it shows other people.
    """

    variance_factor: Floats
    offset: Floats
    other_people: Flags

    @classmethod
    def none(cls, count: int) -> Contradictions:
        """Return the result for cameras without contradictions."""
        return cls(np.ones(count), np.zeros((count, STEP)), np.zeros(count, dtype=np.bool_))


def find_contradictions(
    clip: Clip, frames: Integers, held: HeldOutErrors, settings: BundleAdjustmentSettings
) -> Contradictions:
    """Return the cameras that disagree with all others far beyond their stated errors.

    The errors are those of people in some frames (k,) against joints from the other cameras.
    """
    fewest = 20  # one person, hardly more than once
    limit = 4.0  # twice the stated error, as for one correct camera in thirty
    detections = clip.detections[frames]
    image, weight = detections.by_person()
    joints = clip.joints[frames]
    _, noise = project_joints(clip.cameras, joints, weight, clip.triangulation)
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
        if told.sum() < fewest or np.median(squared[:, c][told]) < limit * MEDIAN_SQUARED:
            continue
        points = _triangulate(clip, clip.cameras, c, detections)
        used = np.isfinite(points[..., 0]) & (weight[:, c] > 0.0)
        used &= np.isfinite(place[:, c])
        used &= np.isfinite(clip.cameras[c].project(points)).all(axis=-1)
        number = int(used.sum())
        if number < fewest:
            found.other_people[c] = True
            continue
        problem = AdjustmentProblem(
            cameras=clip.cameras[c : c + 1],
            free=free[c : c + 1],
            camera_information=information[c : c + 1] / 16.0,
            points=points[used],
            point_information=np.full(number, np.inf),
            point_of=np.arange(number),
            camera_of=np.zeros(number, dtype=np.int64),
            image=image[:, c][used],
            weight=1.0 / place[:, c][used],
            scale=np.full(number, np.inf),
        )
        placed = _place_camera(problem, settings)
        if placed is None:
            found.other_people[c] = True
            continue
        off = placed.cameras[0].project(problem.points) - problem.image
        left = float(np.median((off**2).sum(axis=1) * problem.weight))
        if left > limit * MEDIAN_SQUARED:
            found.other_people[c] = True
            continue
        step = placed.offset[0]
        squared_step = float(step @ information[c] @ step) / int(free[c].sum())
        # Three standard deviations in every direction.
        if squared_step > 9.0:
            found.offset[c], found.variance_factor[c] = step, squared_step
    return found


def _place_camera(
    problem: AdjustmentProblem, settings: BundleAdjustmentSettings
) -> AdjustmentSolution | None:
    """Return the camera fitted to these points; None if it cannot image all of them."""
    offset = None
    # The first scale allows a far step.
    for scale in (30.0, 3.0):
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
