"""Frames that are fitted together, and those of each person among them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.body_fitting.objective import Evidence
from worldpose.body_fitting.settings import BodyFittingSettings

WINDOW_FRAMES: Final = 3000
"""Frames that are solved together: a person's equations take 60 KB per frame."""


def split_windows(
    frames: int, fps: float, settings: BodyFittingSettings
) -> Iterator[tuple[slice, slice]]:
    """Yield frames that are solved together, and those of them that are kept."""
    # Motion ties a pose to those within some tenths of a second.
    margin = math.ceil(max(3.0, 2.0 * settings.max_filled_gap_s) * fps)
    size = max(WINDOW_FRAMES, 2 * margin)
    starts = range(0, frames, size) if frames > size + margin else (0,)
    for start in starts:
        stop = start + size if len(starts) > 1 and start + size < frames else frames
        first, last = max(0, start - margin), min(frames, stop + margin)
        yield slice(first, last), slice(start, stop)


def trim_people(
    spans: Mapping[int, slice], people: Mapping[int, Evidence], first: int, last: int
) -> tuple[dict[int, slice], dict[int, Evidence]]:
    """Return frames and evidence of people from their first observation in a window to the last.

    People without any observation in the frames from `first` to `last` are left out.
    """
    trimmed, evidence = {}, {}
    for person, span in spans.items():
        here = np.flatnonzero(people[person].known.any(axis=1))
        if ((here + span.start >= first) & (here + span.start < last)).any():
            own = slice(int(here[0]), int(here[-1]) + 1)
            trimmed[person] = slice(span.start + own.start, span.start + own.stop)
            its = people[person]
            evidence[person] = Evidence(its.joints[own], its.information[own])
    return trimmed, evidence


def long_gaps(seen: NDArray[np.bool_], max_frames: float) -> NDArray[np.bool_]:
    """Return the frames in gaps of more than `max_frames` frames."""
    places = np.flatnonzero(seen)
    long = np.zeros(len(seen), dtype=bool)
    for first, last in itertools.pairwise(places):
        if last - first - 1 > max_frames:
            long[first + 1 : last] = True
    return long
