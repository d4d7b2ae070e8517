"""A clip's ambiguous identities, and a run's warning about them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from data_contracts.tracking import Join
from worldpose.tracking.person import Person

UNDECIDED_SHARE: Final = 0.2
"""Undecided joins per person [1] up to which a run does not warn: in most clips a person leaves the
view and comes back, and an undecided join leaves two tracks, which mixes up no identities."""
MAX_NAMED: Final = 3
"""Most doubts that the warning names one by one."""


@dataclass(frozen=True)
class Takeover:
    """A frame in which a track may have passed from one person to another.

    A camera lost `person` and then matched a detection that could as well be that of `other`, who
    had one in this camera until then and is not located by two cameras again. If both are on one
    ray, as seen from eye level, no camera tells which of the two the detection shows.
    """

    frame: int
    person: int
    other: int


def find_takeovers(
    people: Sequence[Person],
    frame: int,
    index: Integers,
    affinity: Floats,
) -> list[Takeover]:
    """Return people who, after a gap, took a detection that another person lost in this frame.

    Whether the other person is located again is not known yet.

    Args:
        people: n followed people, before this frame's update.
        frame: number of the frame.
        index: (cameras, n) matched detections; -1 = none.
        affinity: (cameras, n, detections); minus infinity beyond the gates.
    """
    views = np.count_nonzero(index >= 0, axis=0)
    placed = np.array([person.last_fixed == frame - 1 for person in people], dtype=np.bool_)
    back = np.flatnonzero(~placed & (views >= 2))
    found = []
    for n in np.flatnonzero(placed & (views < 2)).tolist() if len(back) else ():
        had = people[n].sightings[frame - 1].index >= 0
        for m in back.tolist():
            camera = np.flatnonzero(had & (index[:, n] < 0) & (index[:, m] >= 0))
            if np.isfinite(affinity[camera, n, index[camera, m]]).any():
                found.append(Takeover(frame, people[m].number, people[n].number))
    return found


def lasting_takeovers(
    takeovers: Iterable[Takeover], lasting: Sequence[Person], chains: Sequence[Sequence[Person]]
) -> tuple[Takeover, ...]:
    """Return takeovers after which a real person was never located again, by final numbers.

    Args:
        takeovers: by numbers of tracks.
        lasting: tracks with enough evidence.
        chains: each final person's tracks.
    """
    tracks = {person.number: person for person in lasting}
    final = {person.number: n for n, chain in enumerate(chains) for person in chain}
    found: dict[tuple[int, int], Takeover] = {}
    for each in takeovers:
        other = tracks.get(each.other)
        if each.person not in final or other is None or other.last_fixed >= each.frame:
            continue
        person, second = final[each.person], final.get(each.other, -1)
        if person != second:
            found[person, each.other] = replace(each, person=person, other=second)
    return tuple(sorted(found.values(), key=lambda each: (each.frame, each.person)))


def describe_doubts(
    frames: Integers,
    people: int,
    takeovers: Sequence[Takeover],
    joins: Sequence[Join],
) -> str | None:
    """Return a warning about ambiguous identities; None if there are few.

    Args:
        frames: (frames,) numbers of the clip's frames.
        people: number of people.
        takeovers: by indices of frames in the clip.
        joins: of the clip, decided or not.
    """
    parts = []
    if takeovers:
        named = [
            f"person {each.person}"
            + (f" and person {each.other}" if each.other >= 0 else "")
            + f" in frame {frames[each.frame]}"
            for each in takeovers[:MAX_NAMED]
        ]
        parts.append(
            f"{_count_noun(len(takeovers), 'track')} may have passed from one person to another "
            f"where one of them is hidden from a camera ({_list_named(named, len(takeovers))})"
        )
    undecided = [join for join in joins if not join.decided]
    if len(undecided) > UNDECIDED_SHARE * people:
        named = [
            f"person {join.before} until frame {frames[join.last_frame]} and person {join.after} "
            f"from frame {frames[join.first_frame]}"
            for join in undecided[:MAX_NAMED]
        ]
        parts.append(
            f"{_count_noun(len(undecided), 'pair')} of tracks may each be one person "
            f"({_list_named(named, len(undecided))})"
        )
    if not parts:
        return None
    return (
        "; ".join(parts)
        + ". Look at these frames on the review pages, and split or join the tracks there"
    )


def _count_noun(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _list_named(named: list[str], count: int) -> str:
    return "; ".join(named) + (f"; and {count - len(named)} more" if count > len(named) else "")
