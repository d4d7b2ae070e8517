"""Removal of shadows: false tracks that follow a person, in a few of the cameras that see it.

If a detector reports halves of two people as a third, in two cameras at once, rays may meet. A real
person so near to another is seen by most of the cameras that see the other; a shadow is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.tracking.person import Person

VIEWS: Final = 0.4
"""Largest share of the cameras that see the other person that a shadow is seen by [1]."""
LASTING: Final = 0.7
"""Least share of its frames in which a shadow has another person so near [1]."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A track in the frames that determine its position.

    Attributes:
        frame: (frames,) rising.
        joints: (frames, 17, 3) [m], world; NaN where not determined.
        views: (frames,) cameras that see it.
    """

    frame: NDArray[np.int64]
    joints: NDArray[np.float64]
    views: NDArray[np.int64]


def without_shadows(people: list[Person], distance: float) -> list[Person]:
    """Return the people without those nearly always close to a person seen by far more cameras.

    Args:
        people: tracks of a clip.
        distance: between bodies, below which one may be the other's shadow [m]; 0 keeps all.
    """
    if distance <= 0.0:
        return people
    seen = [seen_of(person) for person in people]
    return [
        person
        for n, person in enumerate(people)
        if not are_shadow(seen[n : n + 1], seen[:n] + seen[n + 1 :], distance)
    ]


def are_shadow(chain: list[Seen], others: list[Seen], distance: float) -> bool:
    """Return whether a person is nearly always close to a person seen by far more cameras.

    Args:
        chain: the person's tracks.
        others: the tracks of all other people.
        distance: between bodies, below which one may be the other's shadow [m].
    """
    beside = np.concatenate([_beside(track, others, distance) for track in chain])
    return bool(len(beside)) and float(beside.mean()) >= LASTING


def _beside(track: Seen, others: list[Seen], distance: float) -> NDArray[np.bool_]:
    """Return the frames (frames,) in which a person seen by far more cameras is so near."""
    beside = np.zeros(len(track.frame), dtype=np.bool_)
    for other in others:
        _, mine, theirs = np.intersect1d(
            track.frame, other.frame, assume_unique=True, return_indices=True
        )
        fewer = track.views[mine] <= VIEWS * other.views[theirs]
        mine, theirs = mine[fewer], theirs[fewer]
        apart = track.joints[mine] - other.joints[theirs]
        known = np.isfinite(apart[..., 0])
        total = np.where(known[..., None], apart, 0.0).sum(axis=1)
        count = known.sum(axis=1)
        # Of bodies, not of joints: a shadow's joints are another person's, or mix two people's.
        beside[mine] |= np.linalg.norm(total, axis=1) < distance * count
    return beside


def seen_of(person: Person) -> Seen:
    """Return a track in the frames that determine its position."""
    frames = sorted(person.sightings)
    sightings = [person.sightings[frame] for frame in frames]
    joints = np.array([each.joints for each in sightings])
    views = np.array([np.count_nonzero(each.index >= 0) for each in sightings])
    placed = np.isfinite(joints[..., 0]).any(axis=1)
    return Seen(np.array(frames)[placed], joints[placed], views[placed])
