"""Clocks of the cameras: which frame of a camera shows a match frame, and how much it is off.

A camera's `offset_frames` o(f) says that match frame f is its frame

    n(f) = f r + o(f),

with the ratio r of its frame rate and the match's. It is a number, or rising pairs [match frame,
offset] with linear change between them: a clock that runs fast. It is constant before the first
pair and after the last; two pairs at neighbouring frames are a step, of frames that a recorder lost
or repeated. The nearest whole frame is read; the rest is corrected in the people's 2D poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.match import ClockOffset


def exact_frames(frame: Integers, offset: ClockOffset, rate: float = 1.0) -> Floats:
    """Return the exact camera frames (n,) of match frames (n,).

    Args:
        frame: match frames.
        offset: as the camera's `offset_frames`.
        rate: frames of the camera per frame of the match.
    """
    if not isinstance(offset, Sequence):
        return np.asarray(frame * rate + offset, dtype=np.float64)
    at, there = np.array(offset, dtype=np.float64).T
    return np.asarray(frame * rate + np.interp(frame, at, there))


def simplest_offset(frame: Integers, exact: Floats) -> ClockOffset:
    """Return the `offset_frames` with these values (n,) at rising match frames (n,).

    A clock that only steps has whole offsets: a recorder loses and repeats whole frames.
    """
    gap = np.diff(frame)
    slopes = np.abs(np.diff(exact)) / np.maximum(gap, 1)
    drifts = bool(((slopes > 1e-6) & (gap > 1)).any())
    value = np.round(exact, 2) if drifts else np.floor(exact + 0.5)
    if not drifts and (value == value[0]).all():
        return int(value[0])
    pairs = [(int(a), float(b)) for a, b in zip(frame, value, strict=True)]
    if drifts:
        return tuple(pairs)
    ends = [each for step in pairwise(pairs) if step[0][1] != step[1][1] for each in step]
    return tuple(dict.fromkeys(ends))


def camera_frames(frame: Integers, offset: ClockOffset, rate: float = 1.0) -> Integers:
    """Return the nearest camera frame (n,) of each match frame; arguments of `exact_frames`."""
    return np.floor(exact_frames(frame, offset, rate) + 0.5).astype(np.int64)


def remaining_offset(frame: Integers, offset: ClockOffset, rate: float = 1.0) -> Floats:
    """Return how much later than the match frames (n,) their camera frames are [match frame]."""
    exact = exact_frames(frame, offset, rate)
    return np.asarray((np.floor(exact + 0.5) - exact) / rate)
