"""Selection of real people among a clip's tracks, judged by whole people rather than fragments.

A track ends after a moment unseen, so one person usually has several. A fragment of a player may
look like a bystander, while fetching the ball, or like a shadow, if few cameras see the player in a
duel; the player's other tracks show neither.

Bystanders are never on the pitch or near it in 3D. A single camera locates a distant foot
with an error of about a metre, and given 2D poses may show any person. Several cameras locate a
track to centimetres, and so distinguish people waiting behind the lines from players.

A duplicate is a second track of one person, with detections that the first track lost for a moment.
Both are at one place, and no camera shows both; some camera shows two people next to each other as
two detections.

A shadow is a false track that follows a person in a few of the cameras that see the person. If a
detector reports halves of two people as a third person, in two cameras at once, rays may meet. Most
of the cameras that see a person also see a real person so near; they do not see a shadow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Integers, Singles
from worldpose.compiled import compile_kernel
from worldpose.tracking.frame_tracker import FrameTracker
from worldpose.tracking.joins import Candidate, choose_joins, join_costs
from worldpose.tracking.person import Person

MIN_SHADOW_SHARE: Final = 0.7
"""In at least this share of its frames, a shadow has another person so near [1]."""

Chains = list[list[Person]]


def join_people(
    tracks: list[Person], tracker: FrameTracker, pitch_size: tuple[float, float] | None
) -> tuple[list[Candidate], Chains]:
    """Return the joins of a clip's tracks and the people, without shadows and bystanders.

    Tracks, without ghosts, that are neither by themselves are accepted. Another track stays if it
    is joined to an accepted one, the chain as a whole is no shadow, and no join of accepted tracks
    breaks for it. `pitch_size` is as of `drop_bystanders`. Returned are the joins of tracks that
    stay, and each person's tracks in time order.
    """
    settings = tracker.settings
    tracks, merged = merge_duplicates(tracks, settings.merge_distance_m)
    tracker.merged += merged
    sure = drop_shadows(tracks, settings.shadow_distance_m)
    sure = drop_bystanders(sure, pitch_size, settings.pitch_margin_m)
    limited = limit_people(sure, tracker.people)
    joins, chains = join_tracks(limited, tracker)
    if len(sure) == len(tracks):
        return joins, chains
    pairs = [(join.before, join.after) for join in joins if join.decided]
    left = tracks
    while True:
        # Removal of tracks changes the joins: repeat until all joined tracks may stay.
        joins, chains = join_tracks(left, tracker)
        whole = _select_whole(chains, sure, pairs, settings.shadow_distance_m)
        kept = limit_people(whole, tracker.people)
        if len(kept) == len(left):
            return joins, chains
        left = kept


def _select_whole(
    chains: Chains, sure: list[Person], pairs: list[tuple[int, int]], distance: float
) -> list[Person]:
    """Return the accepted tracks, and the others of the chains that pass as a whole."""
    place = {track.number: n for n, chain in enumerate(chains) for track in chain}
    ends = [(place.get(before), place.get(after)) for before, after in pairs]
    torn = {n for pair in ends for n in pair if pair[0] != pair[1]}
    seen = {track.number: located_frames(track) for chain in chains for track in chain}
    kept = []
    for n, chain in enumerate(chains):
        known = [track for track in chain if track in sure]
        if 0 < len(known) < len(chain) and n not in torn:
            mine = {track.number for track in chain}
            others = [each for number, each in seen.items() if number not in mine]
            if not is_shadow([seen[number] for number in mine], others, distance):
                known = chain
        kept.extend(known)
    return sorted(kept, key=lambda track: track.number)


def drop_bystanders(
    people: list[Person], pitch_size: tuple[float, float] | None, margin: float
) -> list[Person]:
    """Return the people without those who are always farther outside than `margin` [m].

    `pitch_size` is the length along x and width along y of the pitch around the origin [m]; None
    keeps all.
    """
    if pitch_size is None:
        return people
    half = 0.5 * np.array(pitch_size)
    return [person for person in people if _distance_outside(person, half) <= margin]


def _distance_outside(person: Person, half: Floats) -> float:
    """Return the least distance outside of the lines [m]; 0 on the pitch or without position."""
    places = person.sightings.stack()[3][..., :2].astype(np.float64)
    places = places[np.isfinite(places[..., 0]).any(axis=1)]
    outside = np.maximum(np.abs(np.nanmean(places, axis=1)) - half, 0.0)
    return float(np.linalg.norm(outside, axis=1).min()) if len(places) else 0.0


@dataclass(frozen=True, eq=False)
class LocatedFrames:
    """A track in the frames that determine its position.

    Attributes:
        frame: (frames,) rising.
        joints: (frames, 17, 3) [m], world; NaN where not determined.
        index: (frames, cameras) its detections; -1 = not seen.
    """

    frame: Integers
    joints: Singles
    index: NDArray[np.int16]

    @property
    def views(self) -> Integers:
        """(frames,) number of cameras that see it."""
        return np.asarray(np.count_nonzero(self.index >= 0, axis=1))


def merge_duplicates(people: list[Person], distance: float) -> tuple[list[Person], int]:
    """Return the people without second tracks, whose detections the first ones take over.

    Bodies nearer than `distance` [m] can be one, in most frames of the shorter track. The second
    result is the number of duplicates.
    """
    seen = {person.number: located_frames(person) for person in people}
    by_length = sorted(people, key=lambda person: (len(seen[person.number].frame), -person.number))
    left = list(people)
    for place, person in enumerate(by_length):
        for other in reversed(by_length[place + 1 :]):
            if _is_duplicate(seen[person.number], seen[other.number], distance):
                other.absorb(person, min(person.sightings))
                left.remove(person)
                break
    return left, len(people) - len(left)


def _is_duplicate(track: LocatedFrames, other: LocatedFrames, distance: float) -> bool:
    """Return whether a track is so near to another in most of its frames, in other cameras."""
    mine, theirs, apart = _common_distances(track, other)
    shared = ((track.index[mine] >= 0) & (other.index[theirs] >= 0)).any(axis=1)
    near = np.count_nonzero(~shared & (apart < distance))
    return bool(len(track.frame) > 0 and near >= MIN_SHADOW_SHARE * len(track.frame))


def drop_shadows(people: list[Person], distance: float) -> list[Person]:
    """Return the people without those that `is_shadow` calls shadows; a distance of 0 keeps all."""
    if distance <= 0.0:
        return people
    seen = [located_frames(person) for person in people]
    return [
        person
        for n, person in enumerate(people)
        if not is_shadow(seen[n : n + 1], seen[:n] + seen[n + 1 :], distance)
    ]


def is_shadow(chain: list[LocatedFrames], others: list[LocatedFrames], distance: float) -> bool:
    """Return whether a person is nearly always close to a person seen by far more cameras.

    `chain` are the person's tracks; a body nearer than `distance` [m] may be another's shadow.
    """
    beside = np.concatenate([_near_better_seen(track, others, distance) for track in chain])
    return bool(len(beside)) and float(beside.mean()) >= MIN_SHADOW_SHARE


def _near_better_seen(track: LocatedFrames, others: list[LocatedFrames], distance: float) -> Flags:
    """Return the frames (frames,) in which a person seen by far more cameras is this close."""
    beside = np.zeros(len(track.frame), dtype=np.bool_)
    views = track.views
    for other in others:
        mine, theirs, apart = _common_distances(track, other)
        # A shadow is seen by at most this share of the cameras that see the other person [1].
        fewer = views[mine] <= 0.4 * other.views[theirs]
        beside[mine] |= fewer & (apart < distance)
    return beside


def _common_distances(
    track: LocatedFrames, other: LocatedFrames
) -> tuple[Integers, Integers, Floats]:
    """Return the frames of two tracks that both have, by place in each, and the distances [m].

    Of bodies, not of joints: a shadow's joints are another person's, or mix two people's. Infinite
    without a common joint.
    """
    return _body_distances(track.frame, track.joints, other.frame, other.joints)


@compile_kernel
def _body_distances(
    frame: Integers, joints: Singles, other_frame: Integers, other_joints: Singles
) -> tuple[Integers, Integers, Floats]:
    """Return `_common_distances` of two tracks.

    Frames (frames,) and (others,) rise; joints are (frames, 17, 3) and (others, 17, 3) [m], world,
    NaN where not determined.
    """
    most = min(len(frame), len(other_frame))
    mine, theirs, apart = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    count = a = b = 0
    while a < len(frame) and b < len(other_frame):
        if frame[a] < other_frame[b]:
            a += 1
        elif frame[a] > other_frame[b]:
            b += 1
        else:
            x = y = z = 0.0
            known = 0
            for joint in range(joints.shape[1]):
                step = joints[a, joint, 0] - np.float64(other_joints[b, joint, 0])
                if not math.isnan(step):
                    x += step
                    y += joints[a, joint, 1] - np.float64(other_joints[b, joint, 1])
                    z += joints[a, joint, 2] - np.float64(other_joints[b, joint, 2])
                    known += 1
            length = math.sqrt(x * x + y * y + z * z)
            mine[count], theirs[count] = a, b
            apart[count] = length / known if known else math.inf
            a, b, count = a + 1, b + 1, count + 1
    return mine[:count], theirs[:count], apart[:count]


def located_frames(person: Person) -> LocatedFrames:
    """Return a track in the frames that determine its position."""
    frames, index, _, joints = person.sightings.stack()
    known = np.isfinite(joints[..., 0]).any(axis=1)
    return LocatedFrames(frames[known], joints[known], index[known])


def people_at_births(people: list[Person]) -> dict[int, list[Person]]:
    """Return the people between birth and last fix, by the frame of every birth."""
    births = sorted({min(person.sightings) for person in people})
    return {
        frame: [person for person in people if min(person.sightings) <= frame <= person.last_fixed]
        for frame in births
    }


def limit_people(people: list[Person], limit: int | None) -> list[Person]:
    """Return the people without those beyond the limit, if any, at a time, with least evidence."""
    if limit is None:
        return people
    kept = list(people)
    for together in people_at_births(people).values():
        still = sorted(
            (person for person in together if person in kept),
            key=lambda person: (-person.evidence, person.number),
        )
        for person in still[limit:]:
            kept.remove(person)
    return kept


def join_tracks(
    tracks: list[Person], tracker: FrameTracker
) -> tuple[list[Candidate], list[list[Person]]]:
    """Return the joins of a clip's tracks, and the people as chains of tracks in time order."""
    if not tracks:
        return [], []
    numbers = [person.number for person in tracks]
    ends = [tracker.track_ends(person) for person in tracks]
    starts, stops = [start for start, _ in ends], [stop for _, stop in ends]
    settings = tracker.settings
    costs = join_costs(stops, starts, tracker.fps, tracker.area, settings)
    joins = choose_joins(stops, starts, costs, tracker.fps, settings)
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
    assert sum(map(len, chains)) == len(tracks)  # a track that is joined to itself begins no chain
    return joins, chains
