"""Paths of people over the ground, and random processes in time: drift and bursts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats

STEP: Final = 0.01
"""Time between samples of a path [s]: 4 cm at 4 m/s, a hundredth of a stride."""
MARGIN: Final = 2.0
"""Path before the first and after the last frame [s]: more than one stride of the slowest walk."""


def sample_times(duration: float) -> Floats:
    """Return the times of a path (samples,) [s], from `MARGIN` before 0 to it after the end."""
    samples = round((duration + 2.0 * MARGIN) / STEP) + 1
    return np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)


@dataclass(frozen=True, eq=False)
class Clip:
    """A person's captured motion.

    Attributes:
        time: (frames,) [s], from 0.
        points: (frames, 13, 3) [m], z up, above the ground, in the order of
            `worldpose.simulation.recordings.read_clip`.
    """

    time: Floats
    points: Floats


@dataclass(frozen=True, eq=False)
class GroundPath:
    """A person's path over the ground, sampled every `STEP`."""

    time: Floats
    """(samples,) [s], from -MARGIN on; 0 is the first frame."""
    position: Floats
    """(samples, 2) [m], world x and y of the pelvis."""
    heading: Floats
    """(samples,) [rad] from the x axis towards y, without jumps."""
    speed: Floats
    """(samples,) [m/s]."""
    clip: Clip | None = None
    """Motion capture that the person plays from time 0 on, instead of a gait."""

    def at(self, times: Floats) -> tuple[Floats, Floats, Floats]:
        """Return place (..., 2) [m], heading [rad] and speed [m/s] at times [s]."""
        x, y, heading, speed = (
            np.interp(times, self.time, each)
            for each in (*self.position.T, self.heading, self.speed)
        )
        return np.stack([x, y], axis=-1), heading, speed


def drift(shape: tuple[int, ...], time: float, fps: float, rng: np.random.Generator) -> Floats:
    """Return a stationary first-order autoregressive process of unit variance along the first axis.

    `shape` is (frames, ...), `time` the time constant [s].
    """
    keep = float(np.exp(-1.0 / (time * fps)))
    process = rng.standard_normal(shape)
    process[1:] *= np.sqrt(1.0 - keep**2)
    # Not scipy's lfilter: all of scipy.signal takes a second to import.
    for frame in range(1, len(process)):
        process[frame] += keep * process[frame - 1]
    return process


def bursts(
    share: float, time: float, shape: tuple[int, ...], fps: float, rng: np.random.Generator
) -> Flags:
    """Return a stationary on-off process along the first axis: on for a given share of the frames.

    `shape` is (frames, ...). Intervals that are on take `time` on average [s], at least one frame;
    `share` is below 1.
    """
    draws = rng.random(shape)
    # A draw below `start` switches on, one above 1 - stop switches off, others change nothing.
    rate = min(1.0, 1.0 / (time * fps * (1.0 - share)))
    start, stop = share * rate, (1.0 - share) * rate
    event = (draws < start).astype(np.int8) - (draws >= 1.0 - stop)
    event[:1] = np.where(draws[:1] < share, 1, -1)
    frame = np.arange(shape[0]).reshape(-1, *(1 for _ in shape[1:]))
    latest = np.maximum.accumulate(np.where(event != 0, frame, 0), axis=0)
    return np.asarray(np.take_along_axis(event, latest, axis=0) > 0)
