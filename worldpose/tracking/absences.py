"""People who are missing: frames of a clip without them between frames that show them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_contracts.arrays import Flags, Integers


def measure_absences(
    present: Flags, frame: Integers, people: Sequence[int], fps: float
) -> dict[str, float]:
    """Return metrics of the time in which people are missing.

    `absent_share` is the larger one of the frames without a person over all frames, and of the
    frames of people who are missing between frames that show them, over all of their frames in
    between [1]. The longest absence lasts from `absent_from_frame` to `absent_to_frame`, and is
    that of `absent_person`, or without this one of all people. `present` (frames, persons) is
    whether a camera sees the tracked person at rising frame numbers (frames,); people have numbers
    (persons,).
    """
    if not present.size:
        return {"absent_share": float(len(frame) > 0)}
    gaps: list[tuple[int, dict[str, float]]] = []
    missing = total = 0
    # Shorter absences are occlusions, which the joints are filled over [s].
    min_seconds = 1.0
    for column, number in enumerate(people):
        rows = np.flatnonzero(present[:, column])
        total += int(rows[-1] - rows[0] + 1) if len(rows) else 0
        steps = np.diff(rows)
        for at in np.flatnonzero(steps - 1 >= min_seconds * fps):
            missing += int(steps[at] - 1)
            ends = _frames(frame, rows[at] + 1, rows[at + 1] - 1)
            gaps.append((int(steps[at] - 1), ends | {"absent_person": number}))
    anyone = np.flatnonzero(present.any(axis=1))
    edges = np.concatenate([[-1], anyone, [len(frame)]])
    empty = np.diff(edges) - 1
    for at in np.flatnonzero(empty >= min_seconds * fps):
        ends = _frames(frame, edges[at] + 1, edges[at + 1] - 1)
        gaps.append((int(empty[at]) * present.shape[1], ends))
    share = max(1.0 - len(anyone) / len(frame), missing / max(1, total))
    _, longest = max(gaps, key=lambda gap: gap[0], default=(0, {}))
    return {"absent_share": share, **longest}


def _frames(frame: Integers, first: int, last: int) -> dict[str, float]:
    """Return the frames of an absence from row `first` to `last`."""
    return {"absent_from_frame": int(frame[first]), "absent_to_frame": int(frame[last])}
