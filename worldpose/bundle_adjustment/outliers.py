"""What disagrees after adjustment, for people to look at (B3): nothing is removed here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.bundle_adjustment.building import KeypointNoise
from worldpose.bundle_adjustment.clip import Clicks, Clip, keypoints_of, predict
from worldpose.cameras import Camera
from worldpose.static_calibration import image_problems, project_with_jacobian
from worldpose.triangulation import triangulate_joints

_WHOLE: Final = 0.5
"""Share of a person's keypoints in one picture from which all of them are off together [1]: taken
for someone else, or left for right."""
_BLOCK: Final = 256
"""Frames at a time: bounds the memory, not the result."""


@dataclass(frozen=True, eq=False)
class KeypointOutliers:
    """The review list of people's keypoints, the most surprising first.

    Attributes:
        frame: (n,) index into the clip's frames.
        camera: (n,)
        person: (n,) index into the clip's people.
        joint: (n,) -1 where most keypoints of this person in this picture are off.
        surprise: (n,) length in standard deviations [1]; the median of a person's.
        found: how many there are, also beyond the list.
    """

    frame: NDArray[np.int64]
    camera: NDArray[np.int64]
    person: NDArray[np.int64]
    joint: NDArray[np.int64]
    surprise: NDArray[np.float64]
    found: int


@dataclass(frozen=True, eq=False)
class ClickReview:
    """All clicked points against the adjusted cameras, the most surprising first.

    Attributes:
        camera: (n,)
        name: of each point of the pitch.
        residual: (n, 2) [px], projected minus clicked; NaN where the camera cannot image the point.
        surprise: (n,) residual in standard deviations of what everything else predicts [1];
            infinite where the camera cannot image the point.
        problem: of each, why the camera cannot image the point; empty where it can.
    """

    camera: NDArray[np.int64]
    name: tuple[str, ...]
    residual: NDArray[np.float64]
    surprise: NDArray[np.float64]
    problem: tuple[str, ...]


def keypoint_outliers(
    clip: Clip, cameras: Camera, noise: KeypointNoise, limit: float, longest: int
) -> KeypointOutliers:
    """Return the keypoints that the other cameras contradict.

    Args:
        clip: keypoints and who is who.
        cameras: (cameras,) batch, adjusted.
        noise: of keypoints, as measured.
        limit: standard deviations from which one is listed [1].
        longest: entries at most.
    """
    parts = [
        _of_block(
            clip, cameras, noise, limit, np.arange(first, min(first + _BLOCK, len(clip.frame)))
        )
        for first in range(0, len(clip.frame), _BLOCK)
    ]
    rows = np.concatenate([np.empty((0, 5)), *parts])
    order = np.lexsort((*rows[:, 3::-1].T, -rows[:, 4]))[:longest]
    frame, camera, person, joint = rows[order, :4].astype(np.int64).T
    return KeypointOutliers(frame, camera, person, joint, rows[order, 4], len(rows))


def _of_block(
    clip: Clip, cameras: Camera, noise: KeypointNoise, limit: float, frames: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Rows (n, 5) of frame, camera, person, joint and surprise."""
    keypoints, confidence = clip.keypoints[frames], clip.confidence[frames]
    index = clip.detection_index[frames]
    joints = triangulate_joints(
        cameras, keypoints, confidence, index.astype(np.int16), clip.triangulation
    ).joints
    image, weight = keypoints_of(keypoints, confidence, index)
    predicted, stated = predict(cameras, joints, weight, clip.triangulation)
    off = np.linalg.norm(predicted - image, axis=-1) / (noise.scale * stated)
    off[~np.isfinite(off)] = np.nan
    wrong = off > limit
    together = wrong.sum(axis=-1) > _WHOLE * np.maximum(np.isfinite(off).sum(axis=-1), 2)
    f, c, p = np.nonzero(together)
    middle = np.nanmedian(off[together], axis=-1) if len(f) else np.empty(0)
    whole = np.column_stack([frames[f], c, p, np.full(len(f), -1), middle])
    f, c, p, j = np.nonzero(wrong & ~together[..., None])
    return np.concatenate([whole, np.column_stack([frames[f], c, p, j, off[f, c, p, j]])])


def review_clicks(
    clicks: tuple[Clicks, ...],
    cameras: Camera,
    covariance: NDArray[np.float64],
    click_noise: float,
) -> ClickReview:
    """Return every clicked point's residual, and how surprising it is.

    Args:
        clicks: of every camera.
        cameras: (cameras,) batch, adjusted.
        covariance: (cameras, 12, 12) of a step; all zero for a given camera.
        click_noise: standard deviation per axis [px].
    """
    camera: list[int] = []
    name: list[str] = []
    problem: list[str] = []
    residual, surprise = [np.empty((0, 2))], [np.empty(0)]
    for c, clicked in enumerate(clicks):
        if not clicked.names:
            continue
        pixel, by_step = project_with_jacobian(cameras[c], clicked.points_world)
        problems = image_problems(cameras[c], clicked.points_world)
        imaged = np.array([not each for each in problems], dtype=np.bool_)
        off = pixel - clicked.points_image
        by_step = np.where(imaged[:, None, None], by_step, 0.0)
        spread = np.einsum("nij,jk,nlk->nil", by_step, covariance[c], by_step)
        # A click that the camera rests on has drawn the camera towards it.
        sign = np.where(clicked.inlier, -1.0, 1.0)[:, None, None]
        values, vectors = np.linalg.eigh(click_noise**2 * np.eye(2) + sign * spread)
        along = np.einsum("nij,ni->nj", vectors, off)
        # Never less than a tenth of the noise: rounding may leave nothing of it.
        values = np.maximum(values, 0.01 * click_noise**2)
        camera += [c] * len(clicked.names)
        name += clicked.names
        problem += problems
        residual.append(off)
        surprise.append(np.where(imaged, np.sqrt((along**2 / values).sum(axis=1)), np.inf))
    order = np.argsort(-np.concatenate(surprise), kind="stable")
    return ClickReview(
        camera=np.array(camera, dtype=np.int64)[order],
        name=tuple(name[index] for index in order),
        residual=np.concatenate(residual)[order],
        surprise=np.concatenate(surprise)[order],
        problem=tuple(problem[index] for index in order),
    )
