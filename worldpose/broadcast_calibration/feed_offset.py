"""Clock offset of the broadcast feed from the static cameras, estimated from people's motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.players import People, boxes_of, match

_COARSE: Final = 25.0
"""Maximum offset of the search [frame]."""
_COARSELY: Final = 80
"""Maximum sample frames in the search over all offsets [1]."""
_FINELY: Final = 400
"""Maximum sample frames about the best offset [1]."""
_SHARE: Final = 0.03
"""Typical keypoint error, as a share of the person's height in the image [1]; the loss scale is
three times this."""
_LASTS: Final = 0.3
"""Correlation time of one person's errors [s]."""


@dataclass(frozen=True, eq=False)
class FeedOffset:
    """Clock offset of a broadcast clip.

    Attributes:
        frames: the clip's frame t corresponds to the static cameras' frame t + frames; NaN where
            `determined` is false.
        standard_error: of the offset [frame]; infinite without motion.
        determined: whether the best offset lies inside the search range, with a standard error
            below half a frame.
        tried: (n,) tested offsets [frame].
        cost: (n,) mean loss of a matched keypoint at each.
        pairs: number of matched people, over all frames.
    """

    frames: float
    standard_error: float
    determined: bool
    tried: Floats
    cost: Floats
    pairs: int


def estimate_feed_offset(
    camera: MovingCamera, people: People, *, reach: float = _COARSE
) -> FeedOffset:
    """Return the clock offset between the feed and the static cameras.

    For every integer offset the function matches people again and evaluates the loss of their
    keypoint residuals; a parabola through the best offset and its neighbours gives the minimum. The
    camera must be independent of these players, or it has absorbed the offset: give one fitted to
    markings alone.

    Args:
        camera: all frames of the clip, from markings and followed points.
        people: joints of the static cameras at the clip's assumed frames, and keypoints of the
            clip.
        reach: maximum offset to either side [frame].
    """
    whole = np.arange(-np.floor(reach), np.floor(reach) + 1.0)
    some, every = (
        np.arange(0, len(camera), -(-len(camera) // most)) for most in (_COARSELY, _FINELY)
    )
    coarse = np.array([_cost(camera, people, offset, some)[0] for offset in whole])
    if not np.isfinite(coarse).any():
        return FeedOffset(np.nan, np.inf, False, whole, coarse, 0)
    best = float(whole[int(np.nanargmin(coarse))])
    # Joints between integer frames would be means of two, with less noise: a parabola through
    # integer offsets avoids this bias.
    near = best + np.arange(-2.0, 3.0)
    results = [_cost(camera, people, offset, every) for offset in near]
    fine = np.array([cost for cost, _ in results])
    middle = int(np.nanargmin(fine)) if np.isfinite(fine).any() else 0
    pairs = results[middle][1]
    inside = 0 < middle < len(near) - 1 and abs(near[middle]) < np.floor(reach)
    left, here, right = fine[middle - 1 : middle + 2] if inside else (np.nan,) * 3
    bend = left - 2.0 * here + right
    if not bend > 0.0:
        return FeedOffset(np.nan, np.inf, False, near, fine, pairs)
    offset = float(near[middle] + 0.5 * (left - right) / bend)
    # Half a loss of one unit is one standard deviation; a person counts once per correlation time.
    stride = -(-len(camera) // len(every))
    independent = pairs / max(1.0, _LASTS * people.fps / stride)
    error = float(np.sqrt(1.0 / (0.5 * bend * independent)))
    determined = error < 0.5
    return FeedOffset(offset if determined else np.nan, error, determined, near, fine, pairs)


def _cost(
    camera: MovingCamera, people: People, offset: float, frames: NDArray[np.int64]
) -> tuple[float, int]:
    """Return the mean loss of a keypoint at an offset, and the number of pairs."""
    at = frames + int(offset)
    inside = (at >= 0) & (at < len(people.joints))
    frames, joints = frames[inside], people.joints[at[inside]]
    if not len(frames):
        return np.nan, 0
    some = People(joints, people.keypoints[frames], people.fps)
    seen = camera.frames(frames)
    pairs = match(seen, some)
    if not len(pairs.frame):
        return np.nan, 0
    world = joints[pairs.frame, pairs.person]
    image = some.keypoints[pairs.frame, pairs.detection]
    tall = np.ptp(np.nan_to_num(boxes_of(image)).reshape(-1, 2, 2)[..., 1], axis=-1)
    single = seen.camera[pairs.frame]
    off = single.project(world) - image
    off = off / np.maximum(_SHARE * tall, 0.5)[:, None, None]
    squared = (off**2).sum(axis=-1)
    squared = squared[np.isfinite(squared)]
    if not len(squared):
        return np.nan, 0
    return float(np.mean(9.0 * squared / (9.0 + squared))), len(pairs.frame)
