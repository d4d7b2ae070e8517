"""Matching of people between two runs by position: each run has its own ids."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.run import RunRecord
from flows.results.best_results import bodies_unit
from worldpose.store import Run, Store

FRAMES: Final = 50
"""Frames whose positions are compared, spread over a clip, so that briefly close people differ."""
NEAR: Final = 1.0
"""Maximum mean joint distance of one person [m]: no two people stay closer for long."""


def paired_people(store: Store, a: RunRecord, b: RunRecord) -> dict[tuple[str, str], str]:
    """Map clip and `person<id>` of B to the name in A, for people whose name in A differs.

    A person of B without a match in A is named `person<id> of B`.
    """
    names = {}
    for bodies in bodies_of_both(Run(store, a), Run(store, b)):
        pairs = bodies.pairs()
        for place, person in enumerate(bodies.person_after.tolist()):
            known = pairs.get(place)
            name = f"person{person} of B"
            if known is not None:
                name = f"person{bodies.person_before[known]}"
            if name != f"person{person}":
                names[bodies.clip, f"person{person}"] = name
    return names


@dataclass(frozen=True, eq=False)
class BodiesOfBoth:
    """Bodies of one clip in two runs, in their common frames.

    Attributes:
        clip: its id.
        frame: (frames,) match frames.
        person_before: (persons,) ids in A.
        person_after: (others,) ids in B.
        before: (frames, persons, 17, 3) [m], world, of A.
        after: (frames, others, 17, 3) [m], world, of B.
    """

    clip: str
    frame: NDArray[np.integer]
    person_before: NDArray[np.integer]
    person_after: NDArray[np.integer]
    before: Floats
    after: Floats

    def pairs(self) -> dict[int, int]:
        """Map person indices of B to those of A, for matched people."""
        step = max(len(self.frame) // FRAMES, 1)
        return pair_people(self.before[::step], self.after[::step])


def bodies_of_both(a: Run, b: Run) -> Iterator[BodiesOfBoth]:
    """Yield the clips whose bodies differ between two runs."""
    clips = {unit.partition("/")[2] for unit in a if unit.startswith("body_fitting/")}
    for clip in sorted(clips):
        one, other = bodies_unit(a, clip), bodies_unit(b, clip)
        if other not in b or a.record.results[one] == b.record.results[other]:
            continue
        frames = np.intersect1d(a[one]["frame"].values, b[other]["frame"].values)
        before, after = (found.sel(frame=frames) for found in (a[one], b[other]))
        yield BodiesOfBoth(
            clip,
            frames,
            before["person"].values,
            after["person"].values,
            before["joints"].values,
            after["joints"].values,
        )


def pair_people(before: Floats, after: Floats) -> dict[int, int]:
    """Map indices of `after` to those of `before`, for mutual nearest neighbours.

    Args:
        before: (frames, persons, joints, 3) [m].
        after: (frames, others, joints, 3) [m], in the same frames.
    """
    if not before.shape[1] or not after.shape[1]:
        return {}
    away = np.linalg.norm(before[:, :, None] - after[:, None], axis=-1)
    known = np.isfinite(away)
    count = known.sum(axis=(0, 3))
    total = np.where(known, away, 0.0).sum(axis=(0, 3))
    mean = np.divide(total, count, out=np.full(count.shape, np.inf), where=count > 0)
    nearest = mean.argmin(axis=0)
    return {
        other: int(person)
        for other, person in enumerate(nearest)
        if mean[person].argmin() == other and mean[person, other] <= NEAR
    }
