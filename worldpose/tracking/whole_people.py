"""Selection of real people among a clip's tracks, judged by whole people rather than fragments.

A track ends after a moment unseen, so one person usually has several. A fragment of a player may
look like a bystander, while fetching the ball, or like a shadow, if few cameras see the player in a
duel; the player's other tracks show neither.
"""

from __future__ import annotations

from worldpose.tracking.bystanders import without_bystanders
from worldpose.tracking.following import Follower
from worldpose.tracking.joining import Candidate
from worldpose.tracking.person import Person
from worldpose.tracking.rosters import within_limit
from worldpose.tracking.shadows import are_shadow, seen_of, without_shadows
from worldpose.tracking.stitching import join_tracks

Chains = list[list[Person]]


def join_people(
    tracks: list[Person], follower: Follower, pitch_size: tuple[float, float] | None
) -> tuple[list[Candidate], Chains]:
    """Return the joins of a clip's tracks and the people, without shadows and bystanders.

    Tracks that are neither by themselves are accepted. Another track stays if it is joined to an
    accepted one, the chain as a whole is no shadow, and no join of accepted tracks breaks for it.

    Args:
        tracks: of the whole clip, without ghosts.
        follower: that made them.
        pitch_size: length and width of the pitch around the origin [m]; None = there are no
            bystanders.

    Returns:
        joins: of the tracks that stay.
        chains: each person's tracks in time order.
    """
    settings = follower.settings
    sure = without_shadows(tracks, settings.shadow_distance)
    sure = without_bystanders(sure, pitch_size, settings.pitch_margin_m)
    limited = within_limit(sure, follower.people)
    joins, chains = join_tracks(limited, follower)
    if len(sure) == len(tracks):
        return joins, chains
    pairs = [(join.before, join.after) for join in joins if join.decided]
    left = tracks
    while True:
        # Removal of tracks changes the joins: repeat until all joined tracks may stay.
        joins, chains = join_tracks(left, follower)
        whole = _whole(chains, sure, pairs, settings.shadow_distance)
        kept = within_limit(whole, follower.people)
        if len(kept) == len(left):
            return joins, chains
        left = kept


def _whole(
    chains: Chains, sure: list[Person], pairs: list[tuple[int, int]], distance: float
) -> list[Person]:
    """Return the accepted tracks, and the others of the chains that pass as a whole.

    Args:
        chains: of all tracks.
        sure: accepted tracks, which always stay.
        pairs: numbers of accepted tracks that are joined in the absence of others.
        distance: of shadows [m].
    """
    place = {track.number: n for n, chain in enumerate(chains) for track in chain}
    ends = [(place.get(before), place.get(after)) for before, after in pairs]
    torn = {n for pair in ends for n in pair if pair[0] != pair[1]}
    seen = {track.number: seen_of(track) for chain in chains for track in chain}
    kept = []
    for n, chain in enumerate(chains):
        known = [track for track in chain if track in sure]
        if 0 < len(known) < len(chain) and n not in torn:
            mine = {track.number for track in chain}
            others = [each for number, each in seen.items() if number not in mine]
            if not are_shadow([seen[number] for number in mine], others, distance):
                known = chain
        kept.extend(known)
    return sorted(kept, key=lambda track: track.number)
