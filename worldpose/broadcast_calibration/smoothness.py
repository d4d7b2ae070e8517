"""Smoothness prior on second differences of rotation, focal length and distortion (M6)."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats
from worldpose.broadcast_calibration.moving_camera import MovingCamera
from worldpose.geometry import Rigid


def second_differences(camera: MovingCamera) -> Floats:
    """Return second differences over frames (frames - 2, 7), in the units of a frame's step."""
    turn = Rigid(
        camera.rotation[1:] @ np.swapaxes(camera.rotation[:-1], -1, -2), np.zeros(3)
    ).rotvec
    lens = np.concatenate([np.log(camera.focal)[:, None], camera.distortion], axis=1)
    return np.concatenate([np.diff(turn, axis=0), np.diff(lens, n=2, axis=0)], axis=1)


def add_smoothness(camera: MovingCamera, spread: Floats, blocks: Floats, right: Floats) -> float:
    """Add squared second differences to the normal equations and return their cost.

    The derivatives assume a small rotation between neighbouring frames: a fast pan has a hundredth
    of a radian per frame.

    Args:
        camera: all frames.
        spread: (7,) standard deviation of a second difference; infinite = free.
        blocks: (3, frames, 7, 7), added to.
        right: (frames, 7), added to.
    """
    used = np.flatnonzero(np.isfinite(spread))
    if len(camera) < 3 or not len(used):
        return 0.0
    gone = second_differences(camera)[:, used] / spread[used]
    information = 1.0 / spread[used] ** 2
    count = len(camera) - 2
    factors = (1.0, -2.0, 1.0)
    for first, one in enumerate(factors):
        rows = slice(first, first + count)
        right[rows, used] += one * gone / spread[used]
        for second in range(first + 1):
            # The block of rows `first` and columns `second` of each triple.
            begin = slice(second, second + count)
            blocks[first - second][begin, used, used] += one * factors[second] * information
    return 0.5 * float((gone**2).sum())
