"""Priors of a clip's cameras, and weights of smoothness and flow estimated from the clip (M6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.records import Record
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.tracking import LENS_POWERS, Chain
from worldpose.geometry.rigid import Rigid

REFERENCE: Final = 2.19
"""Reference focal length of the prior's distortion, in image widths [1]."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of a clip's camera.

    Attributes:
        center: (3,) [m], world.
        center_information: (3, 3) [1/m^2].
        principal_point: (2,) [px].
        principal_std: (2,) [px].
        log_focal: (frames,) mean of the logarithm of the focal length [px].
        log_focal_std: standard deviation of this logarithm in one of the frames.
        distortion: (frames, 3).
        distortion_std: (frames, 3).
    """

    center: Floats
    center_information: Floats
    principal_point: Floats
    principal_std: Floats
    log_focal: Floats
    log_focal_std: float
    distortion: Floats
    distortion_std: Floats


def build_prior(settings: BroadcastPrior, focal: Floats, image_size: Integers) -> Prior:
    """Return the prior of frames with given approximate focal lengths (frames,) [px].

    All frames have one lens: its departure from the prior lasts for the whole clip, so that the
    frames count as one together, however many there are.
    """
    width = float(image_size[0])
    middle = 0.5 * (image_size - 1.0)
    zoom = focal / (REFERENCE * width)
    growth = np.stack([zoom**1.6, zoom, zoom], axis=-1)
    spread = np.array([settings.k1_std, settings.k2_std, settings.k3_std])
    return Prior(
        center=np.array(settings.center_m),
        center_information=np.diag(1.0 / np.square(settings.center_std_m)),
        principal_point=middle + width * np.array(settings.principal_point),
        principal_std=width * np.array(settings.principal_point_std),
        log_focal=np.full(len(focal), np.log(settings.focal * width)),
        log_focal_std=settings.log_focal_std * float(np.sqrt(len(focal))),
        distortion=growth * np.array([settings.k1, settings.k2, 0.0]),
        distortion_std=growth * spread * np.sqrt(len(focal)),
    )


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
    of a radian per frame. The spread (7,) of a second difference is infinite where free; the blocks
    (3, frames, 7, 7) and the right side (frames, 7) are added to.
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


_WINDOW_S: Final = 0.2
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
    """The same deviation for k1: that of the focal length times 1.6 and k1, because a zoom lens's
    distortion changes with its zoom."""
    smooth_k2: float
    """The same deviation for k2: that of the focal length times k2."""
    smooth_frames: float
    """Correlation time of these second differences: the sum of their autocorrelation [frame]."""
    player_share: float
    """Deviation of a keypoint over the person's height: 1.4826 times the median absolute
    residual."""
    player_frames: float
    """Correlation time of a person's errors: the sum of their autocorrelation [frame]."""


def estimate_smoothness(camera: MovingCamera, fps: float) -> Floats:
    """Return the deviation (7,) of second differences in a tracked clip."""
    min_change = np.array([1e-5, 1e-5, 1e-4, 1e-4])  # log focal, k1, k2, k3
    spread = np.full(FRAME_SIZE, np.inf)
    # At 50 frames per second: it bridges frames without evidence and does not affect others.
    spread[:3] = 2e-3 * (50.0 / fps) ** 2
    width = max(1, round(_WINDOW_S * fps))
    if len(camera) < 3 * width:
        spread[3:] = 1.0
        return spread
    change = float(np.sqrt(np.mean(_zoom_changes(camera, width) ** 2)))
    lens = np.median(np.abs(camera.distortion), axis=0)
    # The deviation of k3 uses at least the size of k2.
    lens[2] = max(lens[2], lens[1])
    spread[3:] = np.maximum(np.concatenate([[change], change * LENS_POWERS * lens]), min_change)
    return spread


def correlation_time(camera: MovingCamera, fps: float) -> float:
    """Return the correlation time of second differences of a tracked clip's zoom [frame].

    The correlation time is the sum of the autocorrelation: this number of consecutive frames has
    the information of one independent frame.
    """
    width = max(1, round(_WINDOW_S * fps))
    if len(camera) < 3 * width:
        return 1.0
    bends = _zoom_changes(camera, width)
    power, total = float(np.mean(bends**2)), 1.0
    for lag in range(1, len(bends) // 2):
        correlation = float(np.mean(bends[lag:] * bends[:-lag])) / max(power, 1e-300)
        if correlation < 0.05:
            break
        total += 2.0 * correlation
    return total


def _zoom_changes(camera: MovingCamera, width: int) -> Floats:
    """Return second differences of the log focal length, smoothed over `width` frames."""
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()
    padded = np.pad(np.log(camera.focal), width, mode="reflect", reflect_type="odd")
    return np.diff(np.convolve(padded, window, mode="same")[width:-width], n=2)


def estimate_flow_share(
    links: Chain, key_frames: Integers, deviation: float, drift: float
) -> float:
    """Return the factor on a followed point's loss [0..1], with its deviation [px].

    Without a gap between key frames, the drift [px] applies: the tracking error after one frame,
    growing with the square root of frames.
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
