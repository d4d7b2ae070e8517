"""Weights of smoothness and flow, estimated from the clip (M6)."""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.records import Record
from worldpose.broadcast_calibration.chain import Chain
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.smoothness import second_differences

_HAND: Final = 2e-3
"""Largest plausible second difference of the rotation at 50 frames per second [rad]: it bridges
frames without evidence and does not affect others."""
_LEAST: Final = np.array([1e-5, 1e-5, 1e-4, 1e-4])
"""Minimum deviation of a second difference of log focal, k1, k2, k3."""
_LENS: Final = np.array([1.6, 1.0, 1.0])
"""Powers of the focal length that k1, k2, k3 grow with."""
_WINDOW: Final = 0.2
"""Smoothing window of tracked focal lengths before differencing [s]."""


class Weights(Record):
    """Weights of the cost terms, and the rule behind each number."""

    flow_deviation_px: float
    """Deviation of a followed point's motion: 1.4826 times the median absolute residual of the
    inliers along an axis, and at least the setting."""
    flow_share: float
    """Factor on a followed point's loss: the squared ratio of the drift between key frames that
    independent points would cause to the measured drift; errors within a frame are correlated."""
    smooth_log_focal: float
    """Deviation of second differences: their root mean square in the logarithm of the tracked focal
    lengths, smoothed over 0.2 s."""
    smooth_k1: float
    """As the focal length's, times 1.6 and k1: a zoom lens's distortion changes with its zoom."""
    smooth_k2: float
    """As the focal length's, times k2."""
    smooth_frames: float
    """Correlation time of these second differences: the sum of their autocorrelation [frame]."""
    player_share: float
    """Deviation of a keypoint over the person's height: 1.4826 times the median absolute
    residual."""
    player_frames: float
    """Correlation time of a person's errors: the sum of their autocorrelation [frame]."""


def smoothness_of(camera: MovingCamera, fps: float) -> Floats:
    """Return the deviation (7,) of second differences in a tracked clip.

    Args:
        camera: all frames, as tracked.
        fps: frames per second.
    """
    spread = np.full(FRAME_SIZE, np.inf)
    spread[:3] = _HAND * (50.0 / fps) ** 2
    width = max(1, round(_WINDOW * fps))
    if len(camera) < 3 * width:
        spread[3:] = 1.0
        return spread
    change = float(np.sqrt(np.mean(_bends(camera, width) ** 2)))
    lens = np.median(np.abs(camera.distortion), axis=0)
    # The deviation of k3 uses at least the size of k2.
    lens[2] = max(lens[2], lens[1])
    spread[3:] = np.maximum(np.concatenate([[change], change * _LENS * lens]), _LEAST)
    return spread


def lasting_of(camera: MovingCamera, fps: float) -> float:
    """Return the correlation time of second differences of a tracked clip's zoom [frame].

    The sum of their autocorrelation: so many frames are worth one independent frame.

    Args:
        camera: all frames, as tracked.
        fps: frames per second.
    """
    width = max(1, round(_WINDOW * fps))
    if len(camera) < 3 * width:
        return 1.0
    bends = _bends(camera, width)
    power, total = float(np.mean(bends**2)), 1.0
    for lag in range(1, len(bends) // 2):
        correlation = float(np.mean(bends[lag:] * bends[:-lag])) / max(power, 1e-300)
        if correlation < 0.05:
            break
        total += 2.0 * correlation
    return total


def _bends(camera: MovingCamera, width: int) -> Floats:
    """Return second differences of the log focal length, smoothed over `width` frames."""
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()
    padded = np.pad(np.log(camera.focal), width, mode="reflect", reflect_type="odd")
    return np.diff(np.convolve(padded, window, mode="same")[width:-width], n=2)


def flow_share_of(links: Chain, key_frames: Integers, deviation: float, drift: float) -> float:
    """Return the factor on a followed point's loss [0..1].

    Args:
        links: a tracked clip; without a gap between key frames, `drift` applies.
        key_frames: their numbers, rising.
        deviation: of a followed point's motion [px].
        drift: tracking error after one frame, growing with the square root of frames [px].
    """
    points = np.array([kept.sum() for kept in links.kept])
    if not len(points) or points.max() == 0:
        return 1.0
    # Four parameters per pair from twice as many coordinates as points.
    independent = deviation * np.sqrt(4.0 / np.median(points[points > 0]))
    found = links.drift[np.isfinite(links.drift)]
    if len(found):
        gaps = np.diff(key_frames)[np.isfinite(links.drift)]
        drift = float(np.sqrt(np.mean(found**2 / gaps)))
    return float(min(1.0, (independent / max(drift, 1e-6)) ** 2))


def roughness(camera: MovingCamera) -> Floats:
    """Return root mean square second differences (7,) of a solution."""
    return np.asarray(np.sqrt((second_differences(camera) ** 2).mean(axis=0)))
