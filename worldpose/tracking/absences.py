"""People who are missing: frames of a clip without them between frames that show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_contracts.arrays import Flags, Integers

MIN_SECONDS = 1.0
"""Shorter absences are occlusions, which the joints are filled over [s]."""


def measure_absences(
    present: Flags, frame: Integers, people: Sequence[int], fps: float
) -> tuple[float, list[str]]:
    """Return the share of time in which people are missing [1], and phrases that name the longest.

    It is the larger one of the frames without a person over all frames, and of the frames of people
    who are missing between frames that show them, over all of their frames in between.

    Args:
        present: (frames, persons) whether a camera sees the tracked person.
        frame: (frames,) frame numbers, rising.
        people: (persons,) their numbers.
        fps: frames per second.
    """
    if not present.size:
        return float(len(frame) > 0), []
    gaps: list[tuple[int, str]] = []
    missing = total = 0
    for column, number in enumerate(people):
        rows = np.flatnonzero(present[:, column])
        total += int(rows[-1] - rows[0] + 1) if len(rows) else 0
        steps = np.diff(rows)
        for at in np.flatnonzero(steps - 1 >= MIN_SECONDS * fps):
            missing += int(steps[at] - 1)
            ends = f"{frame[rows[at] + 1]} to {frame[rows[at + 1] - 1]}"
            gaps.append((int(steps[at] - 1), f"person {number} in frames {ends}"))
    anyone = np.flatnonzero(present.any(axis=1))
    edges = np.concatenate([[-1], anyone, [len(frame)]])
    empty = np.diff(edges) - 1
    for at in np.flatnonzero(empty >= MIN_SECONDS * fps):
        ends = f"{frame[edges[at] + 1]} to {frame[edges[at + 1] - 1]}"
        gaps.append((int(empty[at]) * present.shape[1], f"all people in frames {ends}"))
    alone = 1.0 - len(anyone) / len(frame)
    said = [text for _, text in sorted(gaps, key=lambda gap: -gap[0])]
    return max(alone, missing / max(1, total)), said
