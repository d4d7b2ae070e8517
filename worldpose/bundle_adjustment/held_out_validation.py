"""Held-out validation (B3): people outside the adjustment validate every camera's change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.clip import Clip, keypoints_of, predict
from worldpose.bundle_adjustment.gauge import Similarity, align_points
from worldpose.geometry import Camera
from worldpose.triangulation import triangulate_joints

_PARTS: Final = 4
"""Intervals of the time; the errors of a held-out person in one of them count as one
observation."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of held-out people's keypoints in every camera.

    Each joint is triangulated from the other cameras alone.

    Attributes:
        loss: (frames, cameras, persons, 17) Cauchy's loss [1]; NaN without data.
        error: (frames, cameras, persons, 17) length [px].
        joints: (frames, persons, 17, 3) [m], world, from all cameras; NaN without data.
    """

    loss: NDArray[np.float64]
    error: NDArray[np.float64]
    joints: NDArray[np.float64]


def held_out(
    clip: Clip,
    cameras: Camera,
    frames: NDArray[np.int64],
    people: NDArray[np.bool_],
    robust_scale: float,
) -> HeldOut:
    """Return the errors of keypoints against joints from the other cameras.

    Args:
        clip: keypoints and their persons.
        cameras: (cameras,) batch to validate.
        frames: (k,) indices of frames.
        people: (k, persons) bool, held-out people.
        robust_scale: of Cauchy's loss [standard deviations].
    """
    keypoints, confidence = clip.keypoints[frames], clip.confidence[frames]
    index = np.where(people[:, None], clip.detection_index[frames], -1).astype(np.int16)
    loss = np.full((*index.shape, keypoints.shape[-2]), np.nan)
    error = loss.copy()
    judges = np.flatnonzero(people.any(axis=0))
    image, weight = keypoints_of(keypoints, confidence, index[:, :, judges].astype(np.int64))
    for c in range(len(cameras.focal)):
        joints = _without(clip, cameras, c, keypoints, confidence, index[:, :, judges])
        predicted, noise = predict(
            cameras[c : c + 1], joints, weight[:, c : c + 1], clip.triangulation
        )
        length = np.linalg.norm(predicted[:, 0] - image[:, c], axis=-1)
        squared = (length / noise[:, 0]) ** 2
        error[:, c, judges] = length
        loss[:, c, judges] = robust_scale**2 * np.log1p(squared / robust_scale**2)
    loss[~np.isfinite(error)] = np.nan
    joints = np.full((len(frames), index.shape[2], *loss.shape[3:], 3), np.nan)
    joints[:, judges] = _without(clip, cameras, None, keypoints, confidence, index[:, :, judges])
    return HeldOut(loss, error, joints)


def joints_without(
    clip: Clip, cameras: Camera, camera: int, frames: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return joints (k, persons, 17, 3) from all cameras but one [m], world.

    Args:
        clip: keypoints and their persons.
        cameras: (cameras,) batch.
        camera: the camera to leave out.
        frames: (k,) indices of frames.
    """
    index = clip.detection_index[frames].astype(np.int16)
    return _without(clip, cameras, camera, clip.keypoints[frames], clip.confidence[frames], index)


def _without(
    clip: Clip,
    cameras: Camera,
    camera: int | None,
    keypoints: NDArray[np.float64],
    confidence: NDArray[np.float64],
    index: NDArray[np.int16],
) -> NDArray[np.float64]:
    others = index.copy()
    if camera is not None:
        others[:, camera] = -1
    return triangulate_joints(cameras, keypoints, confidence, others, clip.triangulation).joints


@dataclass(frozen=True, eq=False)
class Verdict:
    """Held-out errors before and after a change, over the keypoints valid in both.

    Attributes:
        judges: (cameras,) number of these keypoints [1].
        loss: (cameras, 2) mean of Cauchy's loss before and after [1]; NaN without keypoints.
        error: (cameras, 2) median length before and after [px]; NaN without keypoints.
    """

    judges: NDArray[np.int64]
    loss: NDArray[np.float64]
    error: NDArray[np.float64]


def verdict(before: HeldOut, after: HeldOut) -> Verdict:
    """Return the comparison per camera."""
    count = before.loss.shape[1]
    both = np.isfinite(before.loss) & np.isfinite(after.loss)
    judges = both.sum(axis=(0, 2, 3))
    loss, error = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    for c in np.flatnonzero(judges):
        for side, held in enumerate((before, after)):
            loss[c, side] = held.loss[:, c][both[:, c]].mean()
            error[c, side] = np.median(held.error[:, c][both[:, c]])
    return Verdict(judges, loss, error)


@dataclass(frozen=True)
class Evidence:
    """Result of all held-out people together for a change of all cameras.

    Attributes:
        gain: relative decrease of the loss [1]; negative if it rises.
        significance: decrease of the loss over its standard error [1]. A person in a quarter of the
            time is one observation, since detector errors last.
        shift: common shift of people [m].
        turn: common rotation of people [rad].
        scale: common growth of people [1].
    """

    gain: float
    significance: float
    shift: float
    turn: float
    scale: float


def all_evidence(before: HeldOut, after: HeldOut, cameras: NDArray[np.bool_]) -> Evidence:
    """Return the result of all held-out people together.

    Args:
        before: errors with the initial cameras.
        after: errors with changed cameras.
        cameras: (cameras,) bool, cameras whose keypoints count.
    """
    fall = (before.loss - after.loss)[:, cameras]
    told = np.isfinite(fall)
    part = np.arange(len(fall)) * _PARTS // max(len(fall), 1)
    groups = []
    for person in range(fall.shape[2]):
        for each in range(_PARTS):
            inside = fall[part == each, :, person][told[part == each, :, person]]
            if len(inside):
                groups.append(float(inside.mean()))
    gain = significance = 0.0
    if told.any():
        gain = float(fall[told].sum() / max(before.loss[:, cameras][told].sum(), 1e-12))
    if len(groups) > 1:
        error = float(np.std(groups, ddof=1)) / len(groups) ** 0.5
        significance = float(np.mean(groups)) / max(error, 1e-12)
    moved = common_motion(before.joints, after.joints)
    both = np.isfinite(before.joints[..., 0]) & np.isfinite(after.joints[..., 0])
    shift = 0.0
    if both.any():
        center = before.joints[both].mean(axis=0)
        shift = float(np.linalg.norm(moved.move_points(center) - center))
    turn = float(np.arccos(np.clip((np.trace(moved.rotation) - 1.0) / 2.0, -1.0, 1.0)))
    return Evidence(gain, significance, shift, turn, moved.scale - 1.0)


def common_motion(before: NDArray[np.float64], after: NDArray[np.float64]) -> Similarity:
    """Return the common similarity transform of joints (..., 3)."""
    both = np.isfinite(before).all(axis=-1) & np.isfinite(after).all(axis=-1)
    return align_points(before[both], after[both])
