"""Paths of people from tracking data: npz in, smooth paths out."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Floats
from worldpose.errors import InputError
from worldpose.simulation.paths import MARGIN, STEP, GroundPath

SMOOTHING: Final = 0.15
"""Standard deviation of the smoothing in time [s]: tracking jitters by decimetres between samples,
a runner's path does not."""
COAST: Final = 0.7
"""Time in which people come to a stop before and after the data [s]."""
FACING_SPEED: Final = 0.6
"""Slower people keep their heading [m/s]."""


def read_trajectories(
    path: Path, duration: float, *, most: int | None = None
) -> tuple[list[GroundPath], float]:
    """Return paths of the people in a tracking file, and their duration [s].

    The file is an npz without pickled objects: `xy` (T, N, 2) [m], world axes with the centre
    spot as origin, NaN where a person is absent; `time` (T,) [s] or `fps`; optionally `segment`
    (T,), a number for each chunk without gaps. The longest chunk is used, with the people who are
    present in all of it.

    Args:
        path: the file.
        duration: maximum duration of the clip [s], from the chunk's beginning.
        most: maximum number of people, in file order.

    Raises:
        InputError: unreadable, wrong shapes, or no person present for a fifth of a second.
    """
    xy, time, segment = _read(path)
    edges = np.flatnonzero((np.diff(segment) != 0) | (np.diff(time) <= 0.0)) + 1
    stretches = np.split(np.arange(len(time)), edges)
    rows = max(stretches, key=len)
    rows = rows[time[rows] <= time[rows[0]] + duration + 1e-9]
    there = np.isfinite(xy[rows]).all(axis=(0, 2))
    length = float(time[rows[-1]] - time[rows[0]])
    if len(rows) < 4 or length < 0.2 or not there.any():
        raise InputError(
            str(path),
            expected="a stretch without gaps of 0.2 s and 4 samples, with somebody in all of it",
            found=f"{len(rows)} samples, {length:.2f} s, {int(there.sum())} people",
            todo="Give a longer stretch of tracking data.",
        )
    people = np.flatnonzero(there)[:most]
    clock = time[rows] - time[rows[0]]
    return [_path(clock, xy[rows, person]) for person in people], length


def _read(path: Path) -> tuple[Floats, Floats, Floats]:
    try:
        with np.load(path, allow_pickle=False) as file:
            content = {name: np.asarray(file[name]) for name in file.files if name in _MEMBERS}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise _unusable(path, f"{error}") from error
    xy = content.get("xy", np.empty(0))
    if xy.ndim != 3 or xy.shape[-1] != 2 or len(xy) == 0 or xy.dtype.kind not in "fiu":
        raise _unusable(path, f"xy of shape {xy.shape}")
    fps = content.get("fps", np.array(0.0))
    if "time" not in content and not (fps.size == 1 and float(fps.item()) > 0.0):
        raise _unusable(path, "neither time nor fps")
    time = content["time"] if "time" in content else np.arange(len(xy)) / float(fps.item())
    segment = content.get("segment", np.zeros(len(xy)))
    if time.shape != (len(xy),) or segment.shape != (len(xy),):
        raise _unusable(path, f"time {time.shape}, segment {segment.shape} for {len(xy)} rows")
    return xy.astype(np.float64), time.astype(np.float64), segment.astype(np.float64)


_MEMBERS: Final = ("xy", "time", "fps", "segment")


def _unusable(path: Path, found: str) -> InputError:
    return InputError(
        str(path),
        expected="npz with xy (T, N, 2), and time (T,) or fps",
        found=found,
        todo="See docs/explanation/synthetic.md for the layout.",
    )


def _path(clock: Floats, xy: Floats) -> GroundPath:
    samples = round((clock[-1] + 2.0 * MARGIN) / STEP) + 1
    time = np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)
    spline = CubicSpline(clock, xy)
    within = np.clip(time, 0.0, clock[-1])
    # A straight line fitted to the ends is steadier than the last two samples.
    first, last = (_velocity(clock, xy, at) for at in (0, -1))
    beyond = time - within
    coasted = COAST * np.sign(beyond) * (1.0 - np.exp(-np.abs(beyond) / COAST))
    place = spline(within) + coasted[:, None] * np.where(beyond[:, None] < 0.0, first, last)
    place = gaussian_filter1d(place, SMOOTHING / STEP, axis=0, mode="nearest")
    velocity = np.gradient(place, STEP, axis=0)
    speed = np.linalg.norm(velocity, axis=-1)
    moving = np.flatnonzero(speed > FACING_SPEED)
    heading = np.zeros(samples)
    if len(moving):
        course = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
        heading = np.interp(np.arange(samples), moving, course)
    heading = gaussian_filter1d(heading, SMOOTHING / STEP, mode="nearest")
    return GroundPath(time, place, heading, speed)


def _velocity(clock: Floats, xy: Floats, end: int) -> Floats:
    """Return the velocity (2,) [m/s] over the half second at one end."""
    near = np.abs(clock - clock[end]) <= max(0.5, clock[3] - clock[0])
    slope: Floats = np.polyfit(clock[near], xy[near], 1)[0]
    return slope
