"""By how many frames the broadcast feed is beside the static cameras, seen in how people move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.broadcast_calibration.players import People, boxes_of, match

Floats = NDArray[np.float64]

_COARSE: Final = 25.0
"""Whole frames up to here are tried [frame]."""
_COARSELY: Final = 80
"""Frames that are looked at while whole frames are tried, at most [1]."""
_FINELY: Final = 400
"""Frames that are looked at about the best of them, at most [1]."""
_SHARE: Final = 0.03
"""A keypoint's usual error, of the person's height in the picture [1]; the loss bends at three."""
_LASTS: Final = 0.3
"""Errors of one person are worth one for this long [s]."""


@dataclass(frozen=True, eq=False)
class FeedOffset:
    """The broadcast clip's clock.

    Attributes:
        frames: the clip's frame t shows what the static cameras show at t + frames; NaN where
            `determined` is false.
        standard_error: of it [frame]; infinite where nothing moves.
        determined: whether it is told: the best offset lies within those tried, and is known to
            better than half a frame.
        tried: (n,) offsets tried [frame].
        cost: (n,) mean loss of a matched keypoint at each.
        pairs: people matched, over all frames.
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
    """Return how the feed's frames lie beside those of the static cameras.

    For every whole offset people are matched anew and what their keypoints miss is weighed; between
    the best and its neighbours the answer is where a parabola is lowest. The camera must not rest
    on these players, or it has absorbed what is looked for: give one of markings alone.

    Args:
        camera: all frames of the clip, from markings and followed points.
        people: joints of the static cameras in the clip's frames as they are thought to be, and
            keypoints of the clip.
        reach: offsets up to this far to either side are tried [frame].
    """
    whole = np.arange(-np.floor(reach), np.floor(reach) + 1.0)
    some, every = (
        np.arange(0, len(camera), -(-len(camera) // most)) for most in (_COARSELY, _FINELY)
    )
    coarse = np.array([_cost(camera, people, offset, some)[0] for offset in whole])
    if not np.isfinite(coarse).any():
        return FeedOffset(np.nan, np.inf, False, whole, coarse, 0)
    best = float(whole[int(np.nanargmin(coarse))])
    # Between whole frames joints would be means of two, with less noise: a parabola through whole
    # ones favours none.
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
    # Half a loss of one unit is one standard deviation; a person counts once in a while.
    stride = -(-len(camera) // len(every))
    independent = pairs / max(1.0, _LASTS * people.fps / stride)
    error = float(np.sqrt(1.0 / (0.5 * bend * independent)))
    determined = error < 0.5
    return FeedOffset(offset if determined else np.nan, error, determined, near, fine, pairs)


def _cost(
    camera: MovingCamera, people: People, offset: float, frames: NDArray[np.int64]
) -> tuple[float, int]:
    """Return the mean loss of a keypoint at an offset, and the pairs."""
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
