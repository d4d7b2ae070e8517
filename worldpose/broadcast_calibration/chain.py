"""Initial camera of every frame, tracked from key frames along followed points (M2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.moving_camera import MovingCamera, joined
from worldpose.broadcast_calibration.optical_flow import Followed
from worldpose.broadcast_calibration.turning import modified_z_scores, turn
from worldpose.geometry import Rigid


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
    kept: list[NDArray[np.bool_]]
    residual: list[Floats]
    determined: NDArray[np.bool_]
    drift: Floats


def chain(
    key_frames: Sequence[int], keys: MovingCamera, followed: Sequence[Followed], outlier: float
) -> Chain:
    """Return cameras tracked between key frames, with the drift distributed linearly.

    Args:
        key_frames: indices of the key frames, rising.
        keys: cameras of the key frames, in that order.
        followed: points between all neighbouring frames.
        outlier: maximum modified z-score of an inlier.
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
        residual[pair] = moved.residual
        determined[pair] = moved.determined
        return moved.camera.frames(slice(1, 2))

    first = key_frames[0]
    cameras[first] = keys.frames(slice(0, 1))
    for frame in range(first - 1, -1, -1):
        cameras[frame] = advance(_there(cameras[frame + 1]), frame, True)
    drift = []
    for number, (begin, end) in enumerate(pairwise(key_frames)):
        for frame in range(begin, end):
            cameras[frame + 1] = advance(_there(cameras[frame]), frame, False)
        reached, key = _there(cameras[end]), keys.frames(slice(number + 1, number + 2))
        drift.append(_apart(reached, key))
        for frame in range(begin + 1, end + 1):
            share = (frame - begin) / (end - begin)
            cameras[frame] = _toward(_there(cameras[frame]), reached, key, share)
    for frame in range(key_frames[-1], frames - 1):
        cameras[frame + 1] = advance(_there(cameras[frame]), frame, False)
    whole = joined([_there(camera) for camera in cameras])
    return Chain(whole, kept, residual, determined, np.array(drift))


def _there(camera: MovingCamera | None) -> MovingCamera:
    assert camera is not None  # tracking reaches every frame from its neighbour
    return camera


def _toward(
    camera: MovingCamera, reached: MovingCamera, key: MovingCamera, share: float
) -> MovingCamera:
    """Return a camera after a share of the step from one camera to another."""
    way = Rigid(key.rotation @ np.swapaxes(reached.rotation, -1, -2), np.zeros(3)).rotvec
    step = np.concatenate(
        [way, np.log(key.focal / reached.focal)[:, None], key.distortion - reached.distortion],
        axis=1,
    )
    return camera.stepped(share * step, np.zeros(5))


def _apart(one: MovingCamera, other: MovingCamera) -> float:
    """Return the root mean square pixel distance of equal directions in two single cameras [px]."""
    width, height = one.image_size - 1.0
    grid = np.stack(np.meshgrid([0.1, 0.5, 0.9], [0.1, 0.5, 0.9]), axis=-1).reshape(-1, 2)
    pixels = grid * [width, height]
    rays = one.camera[0].unproject(pixels)
    off = other.camera[0].project(rays.origins + 100.0 * rays.directions) - pixels
    return float(np.sqrt(np.nanmean((off**2).sum(axis=-1)))) if np.isfinite(off).any() else np.inf
