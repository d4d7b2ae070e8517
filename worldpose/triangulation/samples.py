"""Which people and frames of a clip are looked at to learn what holds for all of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Flags
from data_contracts.keypoints import KeypointDetections


def have_views(detections: KeypointDetections[ClipArray], views: int) -> Flags:
    """Return whether at least `views` cameras see each person (frames, persons)."""
    index, length = detections.detection_index, 512
    parts = [
        (index[start : start + length] >= 0).sum(axis=1) >= views
        for start in range(0, max(1, len(index)), length)
    ]
    return np.concatenate(parts)


def sample_frames(there: Flags, joints: int) -> NDArray[np.int64]:
    """Return frames to learn from: all over those with people, and some of each person.

    `there` (frames, persons) is as of `have_views`, with so many joints per person.
    """
    present = there.sum(axis=1)
    busy = np.flatnonzero(present)
    if not len(busy):
        return np.arange(min(1, len(there)))
    # A confidence class then has thousands of observations.
    chosen = _spread(busy, 1 + 6000 // int(np.ceil(present[busy].mean() * joints)))
    # Lengths of a person's limbs need five frames; memory bounds these, the longest tracks first.
    for own in there.T[np.argsort(-there.sum(axis=0), kind="stable")]:
        if len(chosen) < 512 and own[chosen].sum() < 5:
            chosen = np.union1d(chosen, _spread(np.flatnonzero(own), 5))
    return chosen


def _spread(frames: NDArray[np.int64], number: int) -> NDArray[np.int64]:
    """Return at most so many of the frames, evenly."""
    places = np.linspace(0, len(frames) - 1, min(len(frames), number)).astype(np.int64)
    return np.unique(frames[places])


def choose_intervals(there: Flags, length: int) -> list[slice]:
    """Return intervals of frames with people, spread over the clip; `there` as of `have_views`."""
    starts = np.arange(0, max(1, len(there) - length + 1), length)
    people = np.array([there[start : start + length].any(axis=0).sum() for start in starts])
    starts, people = starts[people > 0], people[people > 0]
    # Person-frames in the sample.
    wanted = max(1, 3000 // int(np.ceil(length * people.mean()))) if len(people) else 0
    chosen = np.unique(np.linspace(0, len(starts) - 1, min(len(starts), wanted)).astype(int))
    return [slice(int(starts[n]), int(starts[n]) + length) for n in chosen]


def choose_stretches(there: NDArray[np.bool_], fps: float) -> list[tuple[int, slice]]:
    """Return persons and intervals of frames to learn from, spread over the clip.

    `there` (frames, persons) is whether the person can be triangulated.
    """
    frames, persons = there.shape
    # Length of an interval [s].
    length = max(1, min(frames, round(2.0 * fps)))
    every = [
        (person, slice(start, start + length))
        for start in range(0, max(1, frames - length + 1), length)
        for person in range(persons)
        if 2 * there[start : start + length, person].sum() > length
    ]
    # Intervals of tracks in the sample.
    chosen = np.linspace(0, len(every) - 1, min(len(every), 12)).astype(int)
    return [every[n] for n in np.unique(chosen)]
