"""Tracking: followed points, the rotation between two frames, cameras of all frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import cv2
import numpy as np

from data_contracts.arrays import Flags, Floats, Image, Singles
from worldpose.broadcast_calibration.evidence import FlowEvidence
from worldpose.broadcast_calibration.moving_camera import (
    CLIP_SIZE,
    FRAME_SIZE,
    MovingCamera,
    join_cameras,
)
from worldpose.broadcast_calibration.priors import LENS_POWERS
from worldpose.broadcast_calibration.residuals import flow_residuals, flow_row
from worldpose.compiled import compile_kernel
from worldpose.errors import InputError
from worldpose.geometry.lens_models import load_camera
from worldpose.geometry.optimize.arrow import ArrowSystem
from worldpose.geometry.rigid import Rigid


@dataclass(frozen=True, eq=False)
class Chain:
    """Initial cameras of all frames, tracked from key frames.

    Attributes:
        camera: all frames.
        kept: inlier mask (n,) of the followed points, per pair of neighbours.
        residual: residuals (n, 2) [px] of the followed points, per pair.
        determined: (frames - 1,) whether the pair's points determine the motion.
        drift: (gaps,) tracking error from one key frame to the next, root mean square over the
            image [px].
    """

    camera: MovingCamera
    kept: list[Flags]
    residual: list[Floats]
    determined: Flags
    drift: Floats


def chain(
    key_frames: Sequence[int], keys: MovingCamera, followed: Sequence[Followed], outlier: float
) -> Chain:
    """Return the cameras of all frames, tracked from each key frame to the next.

    At the next key frame the tracked camera differs from the calibrated one by the drift. Pairs
    that do not determine the motion have all of it, else it is distributed linearly over the pairs.
    Inliers have smaller z-scores than `outlier`.
    """
    frames = len(followed) + 1
    cameras: list[MovingCamera | None] = [None] * frames
    kept = [np.zeros(len(pair.start), dtype=np.bool_) for pair in followed]
    residual = [np.full((len(pair.start), 2), np.nan) for pair in followed]
    determined = np.zeros(frames - 1, dtype=np.bool_)

    def advance(camera: MovingCamera, pair: int, backwards: bool) -> MovingCamera:
        points = followed[pair]
        if backwards:
            points = replace(points, start=points.end, end=points.start)
        moved = turn(camera, points)
        with np.errstate(invalid="ignore"):
            kept[pair] = modified_z_scores(moved.residual) < outlier
        kept[pair] &= points.step == 1
        residual[pair] = moved.residual
        determined[pair] = moved.determined and points.step == 1
        return moved.camera.frames(slice(1, 2))

    first = key_frames[0]
    cameras[first] = keys.frames(slice(0, 1))
    for frame in range(first - 1, -1, -1):
        cameras[frame] = advance(_require(cameras[frame + 1]), frame, True)
    drift = []
    for number, (begin, end) in enumerate(pairwise(key_frames)):
        for frame in range(begin, end):
            cameras[frame + 1] = advance(_require(cameras[frame]), frame, False)
        reached, key = _require(cameras[end]), keys.frames(slice(number + 1, number + 2))
        drift.append(_direction_error(reached, key))
        broken = ~determined[begin:end]
        shares = np.cumsum(broken if broken.any() else ~broken) / (broken.sum() or end - begin)
        for frame, share in enumerate(shares, begin + 1):
            cameras[frame] = _correct_drift(_require(cameras[frame]), reached, key, share)
    for frame in range(key_frames[-1], frames - 1):
        cameras[frame + 1] = advance(_require(cameras[frame]), frame, False)
    whole = join_cameras([_require(camera) for camera in cameras])
    return Chain(whole, kept, residual, determined, np.array(drift))


def _require(camera: MovingCamera | None) -> MovingCamera:
    assert camera is not None  # tracking reaches every frame from its neighbour
    return camera


def _correct_drift(
    camera: MovingCamera, reached: MovingCamera, key: MovingCamera, share: float
) -> MovingCamera:
    """Return a camera after a share of the step from one camera to another."""
    way = Rigid(key.rotation @ np.swapaxes(reached.rotation, -1, -2), np.zeros(3)).rotvec
    step = np.concatenate(
        [way, np.log(key.focal / reached.focal)[:, None], key.distortion - reached.distortion],
        axis=1,
    )
    return camera.take_step(share * step, np.zeros(5))


def _direction_error(one: MovingCamera, other: MovingCamera) -> float:
    """Return the root mean square pixel distance of equal directions in two single cameras [px]."""
    width, height = one.image_size - 1.0
    grid = np.stack(np.meshgrid([0.1, 0.5, 0.9], [0.1, 0.5, 0.9]), axis=-1).reshape(-1, 2)
    pixels = grid * [width, height]
    rays = one.camera[0].unproject(pixels)
    off = other.camera[0].project(rays.origins + 100.0 * rays.directions) - pixels
    return float(np.sqrt(np.nanmean((off**2).sum(axis=-1)))) if np.isfinite(off).any() else np.inf


class Turned(NamedTuple):
    """The camera of the second of two frames."""

    camera: MovingCamera
    """Two frames: the given one, and the next."""
    residual: Floats
    """(n, 2) of the followed points, predicted minus observed [px]; NaN without a prediction."""
    determined: bool
    """Whether the points determine the motion."""


def turn(camera: MovingCamera, followed: Followed) -> Turned:
    """Return the next frame's rotation, zoom and lens from one frame's camera."""
    both = replace(
        camera,
        rotation=np.repeat(camera.rotation, 2, axis=0),
        focal=np.repeat(camera.focal, 2),
        distortion=np.repeat(camera.distortion, 2, axis=0),
    )
    if len(followed.start) < 8:
        return Turned(both, np.full((len(followed.start), 2), np.nan), False)
    ones, first = np.ones(len(followed.start)), np.zeros(len(followed.start), dtype=np.int64)
    # The median motion is a robust start.
    x, y = np.median(followed.end - followed.start, axis=0) / float(both.focal[0])
    both = _move_second(both, np.array([-y, x, 0.0, 0.0]))
    for scale in (20.0, 5.0, 1.5, 0.6, 0.6):
        system = ArrowSystem.zeros(2, FRAME_SIZE, CLIP_SIZE)
        flow = FlowEvidence(first, followed.start, followed.end, scale * ones)
        flow_residuals(both, flow, 1.0, 1.0, system)
        normal = system.blocks[0, 1, :4, :4]
        normal = normal + 1e-9 * np.diag(np.diag(normal))
        if not np.linalg.cond(normal) < 1e12:
            return Turned(both, flow_errors(both, followed), False)
        both = _move_second(both, np.asarray(-np.linalg.solve(normal, system.right[1, :4])))
    return Turned(both, flow_errors(both, followed), True)


def flow_errors(both: MovingCamera, followed: Followed) -> Floats:
    """Return predicted minus observed pixels of followed points (n, 2)."""
    residual = np.full((len(followed.start), 2), np.nan)
    _residuals(both.rows, followed.start, followed.end, residual)
    return residual


def modified_z_scores(residual: Floats) -> Floats:
    """Return each point's modified z-score (n,), the larger of both axes.

    The score is 0.6745 times the distance of the residual (n, 2) [px] from the median, divided by
    the median of these distances (Iglewicz and Hoaglin, 1993). It is NaN where the residual is
    missing.
    """
    if not np.isfinite(residual).any():
        return np.full(len(residual), np.nan)
    off = np.abs(residual - np.nanmedian(residual, axis=0))
    spread = np.maximum(np.nanmedian(off, axis=0), 1e-6)
    return np.asarray((0.6745 * off / spread).max(axis=-1))


def _move_second(both: MovingCamera, step: Floats) -> MovingCamera:
    """Return both frames after a step (4,) of the second: rotation, log focal length."""
    whole = np.zeros((2, 7))
    whole[1, :4] = step
    moved = both.take_step(whole, np.zeros(5))
    growth = (moved.focal[1] / moved.focal[0]) ** LENS_POWERS
    lens = np.stack([both.distortion[0], both.distortion[0] * growth])
    return replace(moved, distortion=lens)


@compile_kernel
def _residuals(cameras: Floats, start: Floats, end: Floats, residual: Floats) -> None:
    """Write residuals (n, 2) of followed points; rows without a prediction stay unchanged."""
    pixel, rows = np.empty(2), np.empty((2, 16))
    before, after = load_camera(cameras, 0), load_camera(cameras, 1)
    for i in range(len(start)):
        if flow_row(before, after, start[i, 0], start[i, 1], pixel, rows):
            residual[i, 0] = pixel[0] - end[i, 0]
            residual[i, 1] = pixel[1] - end[i, 1]


_WINDOW: Final = (21, 21)


@dataclass(frozen=True, eq=False)
class Followed:
    """Points followed from one frame to the next.

    Attributes:
        start: (n, 2) [px].
        end: (n, 2) [px].
        inlier_share: share of the searched points that are inliers of one homography [1]; NaN with
            too few points.
        step: number of frames from `start` to `end`; above 1, the pair only continues the chain.
    """

    start: Floats
    end: Floats
    inlier_share: float
    step: int = 1


def follow(pictures: Iterable[Image], boxes: Floats | None, points: int) -> list[Followed]:
    """Return the points followed between all neighbouring grey frames (height, width).

    The function selects new corners in every frame, evenly over the image, so that errors do not
    accumulate along a track. Pyramidal Lucas-Kanade runs forward and backward; points with a large
    forward-backward error are dropped. People in boxes (frames, detections, 4) [px] move.
    After a flash or a black frame, points of the last frame before it are followed.
    """
    followed: list[Followed] = []
    before: Image | None = None
    good: tuple[int, Image] | None = None
    for number, picture in enumerate(pictures):
        size = picture.shape if before is None else before.shape
        if picture.ndim != 2 or picture.dtype != np.uint8 or picture.shape != size:
            raise InputError(
                "pictures",
                expected="grey images of one size, uint8 (height, width)",
                found=f"{picture.dtype} {picture.shape} as image {number}",
                todo="Read them with `frames(grey=True)`.",
            )
        if before is not None:
            people = None if boxes is None else boxes[number - 1]
            pair = _follow(before, picture, people, points)
            if good is not None and np.isnan(pair.inlier_share):
                people = None if boxes is None else boxes[good[0]]
                across = replace(_follow(good[1], picture, people, points), step=number - good[0])
                pair = across if across.inlier_share > 0.5 else pair
            followed.append(pair)
        if before is None or not np.isnan(followed[-1].inlier_share):
            good = number, picture
        before = picture
    return followed


def _follow(before: Image, after: Image, people: Floats | None, points: int) -> Followed:
    fewest = 12  # points to decide on a cut
    levels = 4  # of the pyramid: motion up to 150 px per frame
    start = _corners(before, people, points)
    if len(start) < fewest:
        return Followed(np.empty((0, 2)), np.empty((0, 2)), float("nan"))
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, start.copy(), winSize=_WINDOW, maxLevel=levels
    )
    returned, back, _ = cv2.calcOpticalFlowPyrLK(
        after, before, end, end.copy(), winSize=_WINDOW, maxLevel=levels
    )
    size = np.array([before.shape[1], before.shape[0]])
    # Near the border the window extends beyond the image.
    inside = ((end > _WINDOW[0] / 2) & (end < size - 1 - _WINDOW[0] / 2)).all(axis=-1)
    same = np.linalg.norm(returned - start, axis=-1) < 0.3
    kept = (found[:, 0] == 1) & (back[:, 0] == 1) & same & inside
    matched_start, matched_end = start[kept].astype(np.float64), end[kept].astype(np.float64)
    searched = float(inside.sum())
    if len(matched_start) < fewest or searched < fewest:
        return Followed(matched_start, matched_end, 0.0 if searched >= fewest else float("nan"))
    _, agree = cv2.findHomography(matched_start, matched_end, cv2.RANSAC, 1.5)
    share = 0.0 if agree is None else float(agree.sum()) / searched
    return Followed(matched_start, matched_end, share)


def _corners(picture: Image, people: Floats | None, points: int) -> Singles:
    """Return corners (n, 2) [px], the strongest of each image cell, outside people's boxes."""
    cells = (16, 9)  # columns and rows, each with its share of the points
    half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    strength = cv2.cornerMinEigenVal(half, 5)
    margin = _WINDOW[0] // 2
    strength[:margin] = strength[-margin:] = 0.0
    strength[:, :margin] = strength[:, -margin:] = 0.0
    for x0, y0, x1, y1 in np.empty((0, 4)) if people is None else people:
        if np.isfinite(x0 + y0 + x1 + y1):
            away = 0.15 * (y1 - y0) + margin
            left, right = max(0.5 * (x0 - away), 0.0), max(0.5 * (x1 + away), 0.0)
            top, bottom = max(0.5 * (y0 - away), 0.0), max(0.5 * (y1 + away), 0.0)
            strength[int(top) : int(bottom) + 1, int(left) : int(right) + 1] = 0.0
    peaks = strength == cv2.dilate(strength, np.ones((7, 7), np.uint8))
    peaks &= strength > max(0.002 * float(strength.max()), 1e-7)
    v, u = np.nonzero(peaks)
    height, width = half.shape
    cell = (u * cells[0] // width) + cells[0] * (v * cells[1] // height)
    order = np.lexsort((-strength[v, u], cell))
    cell = cell[order]
    first = np.searchsorted(cell, cell)
    each = max(1, round(points / (cells[0] * cells[1])))
    chosen = order[np.arange(len(cell)) - first < each]
    # The center of a half-resolution pixel is between two full-resolution pixels.
    return np.stack([2 * u[chosen] + 0.5, 2 * v[chosen] + 0.5], axis=-1).astype(np.float32)
