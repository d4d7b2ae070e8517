"""Tracks of a whole clip joined into people across gaps."""

from __future__ import annotations

from worldpose.tracking.following import Follower
from worldpose.tracking.joining import Candidate, decide, join_costs
from worldpose.tracking.person import Person


def join_tracks(
    tracks: list[Person], follower: Follower
) -> tuple[list[Candidate], list[list[Person]]]:
    """Return the joins of a clip's tracks, and the people as chains of tracks in time order."""
    if not tracks:
        return [], []
    numbers = [person.number for person in tracks]
    ends = [follower.end_of(person) for person in tracks]
    starts, stops = [start for start, _ in ends], [stop for _, stop in ends]
    settings = follower.settings
    costs = join_costs(stops, starts, follower.fps, follower.area, settings)
    joins = decide(stops, starts, costs, settings)
    after = {join.before: join.after for join in joins if join.decided}
    people = {person.number: person for person in tracks}
    chains = []
    for number in numbers:
        if number in after.values():
            continue
        chain = [people[number]]
        while chain[-1].number in after:
            chain.append(people[after[chain[-1].number]])
        chains.append(chain)
    return joins, chains
