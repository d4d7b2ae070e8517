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
    image, weight = keypoints_of(keypoints, confidence, index.astype(np.int64))
    loss = np.full(weight.shape, np.nan)
    error = np.full(weight.shape, np.nan)
    for c in range(len(cameras.focal)):
        others = index.copy()
        others[:, c] = -1
        joints = triangulate_joints(
            cameras, keypoints, confidence, others, clip.triangulation
        ).joints
        predicted, noise = predict(
            cameras[c : c + 1], joints, weight[:, c : c + 1], clip.triangulation
        )
        error[:, c] = np.linalg.norm(predicted[:, 0] - image[:, c], axis=-1)
        squared = (error[:, c] / noise[:, 0]) ** 2
        loss[:, c] = robust_scale**2 * np.log1p(squared / robust_scale**2)
    loss[~np.isfinite(error)] = np.nan
    return HeldOut(loss, error)


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
