"""The moving camera: a tripod on the main stand, and an operator who follows the action."""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.geometry import Camera, Rigid
from worldpose.simulation.processes import drift
from worldpose.simulation.settings import BroadcastSettings
from worldpose.simulation.stadium import looking

CALM: Final = 0.02
"""Time step of the operator's motion [s]: one frame at 50 per second."""
WARM_UP: Final = 1.5
"""Time for which the operator follows the action before the first frame [s]."""


def film(
    settings: BroadcastSettings,
    times: Floats,
    action: Floats,
    action_times: Floats,
    image_size: tuple[int, int],
    rng: np.random.Generator,
) -> Camera:
    """Return the broadcast camera of every frame, a batch (frames,), with one center (M1).

    Pan and tilt follow a smoothed action through two equal first-order lags, like a damped head;
    the zoom varies between wide and close. Radial distortion grows with the focal length, as in the
    released clips: k1 0.1 to 1, k2 0.6 to 4.3.

    Args:
        settings: place, zoom and operator.
        times: (frames,) [s].
        action: (samples, 2) [m], world; place of the action.
        action_times: (samples,) [s], from `WARM_UP` before the first frame to the last.
        image_size: width, height [px].
        rng: the camera's and the operator's own.
    """
    center = np.array(
        [
            rng.uniform(-settings.aside, settings.aside),
            -rng.uniform(*settings.setback),
            rng.uniform(*settings.height),
        ]
    )
    hand = np.arange(times[0] - WARM_UP, times[-1] + 2.0 * CALM, CALM)
    aim = np.stack([np.interp(hand, action_times, axis) for axis in action.T], axis=-1)
    aim[:, 0] += settings.sway * _smooth(drift(hand.shape, 2.5, 1.0 / CALM, rng), 0.6)
    aim[:, 0] += settings.sweep * np.sin(2.0 * np.pi * (hand / 8.0 + rng.random()))
    # The image centre stays within the pitch, nearer to the camera than the action's far side.
    aim = np.clip(0.9 * aim, [-40.0, -22.0], [40.0, 26.0])
    aim = _smooth(_smooth(aim, 0.5 * settings.lag), 0.5 * settings.lag)
    aim = np.stack([np.interp(times, hand, axis) for axis in aim.T], axis=-1)

    low, high = settings.focal
    period = rng.uniform(*settings.zoom_period)
    wave = np.sin(2.0 * np.pi * (times / period + rng.random()))
    focal = low * (high / low) ** (0.5 + 0.5 * wave)
    roll = np.radians(0.15) * rng.standard_normal()
    poses = [looking(center, np.array([*point, 1.0]), roll) for point in aim]
    glass, width = rng.uniform(0.85, 1.15, 2), np.array(image_size, dtype=np.float64)
    zoomed = focal / 4200.0
    k1 = np.clip(0.42 * glass[0] * zoomed**1.6, 0.0, 1.0)
    k2 = np.clip(1.6 * glass[1] * zoomed, 0.0, 4.3)
    nothing = np.zeros_like(k1)
    offset = np.array([rng.uniform(-16.0, 12.0), rng.uniform(-60.0, -3.0)])
    return Camera(
        focal=np.stack([focal, focal], axis=-1),
        principal_point=np.broadcast_to((width - 1.0) / 2.0 + offset, (len(times), 2)),
        distortion=np.stack([k1, k2, nothing, nothing, nothing], axis=-1),
        cam_from_world=Rigid(
            np.stack([pose.rotation for pose in poses]),
            np.stack([pose.translation for pose in poses]),
        ),
        image_size=np.array(image_size),
    )


def _smooth(signal: Floats, time: float) -> Floats:
    """Return a first-order lag along the first axis."""
    smoothed = np.empty_like(signal)
    keep = float(np.exp(-CALM / time))
    smoothed[0] = signal[0]
    for i in range(1, len(signal)):
        smoothed[i] = keep * smoothed[i - 1] + (1.0 - keep) * signal[i]
    return smoothed
