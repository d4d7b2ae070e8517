"""The guard (B3): people who had no part in it judge every camera's change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.clip import Clip, keypoints_of, predict
from worldpose.cameras import Camera
from worldpose.triangulation import triangulate_joints


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Errors of left-out people's keypoints in every camera.

    Each joint is triangulated from the other cameras alone.

    Attributes:
        loss: (frames, cameras, persons, 17) Cauchy's loss [1]; NaN where there is none.
        error: (frames, cameras, persons, 17) length [px].
    """

    loss: NDArray[np.float64]
    error: NDArray[np.float64]


def held_out(
    clip: Clip,
    cameras: Camera,
    frames: NDArray[np.int64],
    people: NDArray[np.bool_],
    robust_scale: float,
) -> HeldOut:
    """Return how well cameras agree about people.

    Args:
        clip: keypoints and who is who.
        cameras: (cameras,) batch to be judged.
        frames: (k,) indices of frames.
        people: (k, persons) bool, the judges.
        robust_scale: of Cauchy's loss [standard deviations].
    """
    keypoints, confidence = clip.keypoints[frames], clip.confidence[frames]
    index = np.where(people[:, None], clip.detection_index[frames], -1).astype(np.int16)
    loss = np.full((*index.shape, keypoints.shape[-2]), np.nan)
    error = loss.copy()
    judges = np.flatnonzero(people.any(axis=0))
    index = index[:, :, judges]
    image, weight = keypoints_of(keypoints, confidence, index.astype(np.int64))
    for c in range(len(cameras.focal)):
        joints = _without(clip, cameras, c, keypoints, confidence, index)
        predicted, noise = predict(
            cameras[c : c + 1], joints, weight[:, c : c + 1], clip.triangulation
        )
        length = np.linalg.norm(predicted[:, 0] - image[:, c], axis=-1)
        squared = (length / noise[:, 0]) ** 2
        error[:, c, judges] = length
        loss[:, c, judges] = robust_scale**2 * np.log1p(squared / robust_scale**2)
    loss[~np.isfinite(error)] = np.nan
    return HeldOut(loss, error)


def joints_without(
    clip: Clip, cameras: Camera, camera: int, frames: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return joints (k, persons, 17, 3) from all cameras but one [m], world.

    Args:
        clip: keypoints and who is who.
        cameras: (cameras,) batch.
        camera: the one that is left out.
        frames: (k,) indices of frames.
    """
    index = clip.detection_index[frames].astype(np.int16)
    return _without(clip, cameras, camera, clip.keypoints[frames], clip.confidence[frames], index)


def _without(
    clip: Clip,
    cameras: Camera,
    camera: int,
    keypoints: NDArray[np.float64],
    confidence: NDArray[np.float64],
    index: NDArray[np.int16],
) -> NDArray[np.float64]:
    others = index.copy()
    others[:, camera] = -1
    return triangulate_joints(cameras, keypoints, confidence, others, clip.triangulation).joints


@dataclass(frozen=True, eq=False)
class Verdict:
    """Left-out people's errors before and after a change, over what both can tell.

    Attributes:
        judges: (cameras,) keypoints that tell [1].
        loss: (cameras, 2) mean of Cauchy's loss before and after [1]; NaN without judges.
        error: (cameras, 2) median length before and after [px]; NaN without judges.
    """

    judges: NDArray[np.int64]
    loss: NDArray[np.float64]
    error: NDArray[np.float64]


def verdict(before: HeldOut, after: HeldOut) -> Verdict:
    """Return the comparison, camera by camera."""
    count = before.loss.shape[1]
    both = np.isfinite(before.loss) & np.isfinite(after.loss)
    judges = both.sum(axis=(0, 2, 3))
    loss, error = np.full((count, 2), np.nan), np.full((count, 2), np.nan)
    for c in np.flatnonzero(judges):
        for side, held in enumerate((before, after)):
            loss[c, side] = held.loss[:, c][both[:, c]].mean()
            error[c, side] = np.median(held.error[:, c][both[:, c]])
    return Verdict(judges, loss, error)
