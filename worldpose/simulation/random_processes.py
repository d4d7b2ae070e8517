"""Random processes in time: drift and bursts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def drift(
    shape: tuple[int, ...], time: float, fps: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return a stationary first-order autoregressive process of unit variance along the first axis.

    Args:
        shape: (frames, ...).
        time: time constant [s].
        fps: [1/s].
        rng: draws `shape` normal numbers.
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
) -> NDArray[np.bool_]:
    """Return a stationary on-off process along the first axis: on for a given share of the frames.

    Args:
        share: share of frames that are on, below 1.
        time: mean length of an interval that is on [s]; at least one frame.
        shape: (frames, ...).
        fps: [1/s].
        rng: draws `shape` uniform numbers.
    """
    draws = rng.random(shape)
    # A draw below `start` switches on, one above 1 - stop switches off, others change nothing.
    rate = min(1.0, 1.0 / (time * fps * (1.0 - share)))
    start, stop = share * rate, (1.0 - share) * rate
    event = (draws < start).astype(np.int8) - (draws >= 1.0 - stop)
    event[:1] = np.where(draws[:1] < share, 1, -1)
    frame = np.arange(shape[0]).reshape(-1, *(1 for _ in shape[1:]))
    latest = np.maximum.accumulate(np.where(event != 0, frame, 0), axis=0)
    on: NDArray[np.bool_] = np.take_along_axis(event, latest, axis=0) > 0
    return on
