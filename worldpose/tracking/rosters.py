"""Limit on the number of simultaneous tracks, from the roster."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from data_contracts.match import PlayerSpec
from worldpose.tracking.person import Person

TEAM = 11
"""Players of a team on the pitch (Laws of the Game, 3)."""


def alive(people: list[Person]) -> dict[int, list[Person]]:
    """Return the people between birth and last fix, by the frame of every birth."""
    births = sorted({min(person.sightings) for person in people})
    return {
        frame: [person for person in people if min(person.sightings) <= frame <= person.last_fixed]
        for frame in births
    }


def within_limit(people: list[Person], limit: int | None) -> list[Person]:
    """Return the people without those beyond the limit at any time, who have the least evidence.

    Args:
        people: tracks of a clip.
        limit: most people at once; None = any number.
    """
    if limit is None:
        return people
    kept = list(people)
    for together in alive(people).values():
        still = sorted(
            (person for person in together if person in kept),
            key=lambda person: (-person.evidence, person.number),
        )
        for person in still[limit:]:
            kept.remove(person)
    return kept


def people_allowed(roster: Sequence[PlayerSpec]) -> int | None:
    """Return the most people on the pitch at once in a match with this roster.

    Eleven of each of two teams and the officials; None for a smaller roster, which may leave out
    people.
    """
    teams = Counter(person.team for person in roster if person.role != "official")
    officials = sum(person.role == "official" for person in roster)
    complete = len(teams) == 2 and min(teams.values()) >= TEAM and officials > 0
    return 2 * TEAM + officials if complete else None
