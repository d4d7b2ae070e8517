"""Joins of track fragments with their odds, takeovers of tracks, and the warning about doubts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Flags, Floats, Integers
from data_contracts.conventions import COCO17_TORSO
from data_contracts.tracking import Join
from worldpose.tracking.epipolar import limb_lengths
from worldpose.tracking.person import Person
from worldpose.tracking.settings import TrackingSettings


@dataclass(frozen=True)
class End:
    """Start or end of a track.

    Attributes:
        number: number of the track.
        frame: first or last frame.
        place: (2,) [m], on the ground.
        velocity: (2,) [m/s]; NaN where unknown.
        limbs: (11,) lengths [m], over the whole track; NaN where unknown.
        limb_variance: (11,) variance of those lengths [m^2].
    """

    number: int
    frame: int
    place: Floats
    velocity: Floats
    limbs: Floats
    limb_variance: Floats


@dataclass(frozen=True)
class Candidate:
    """A possible join of two tracks, the later one as continuation of the earlier.

    Attributes:
        before: number of the track that ends, in `last_frame`.
        after: number of the track that begins, in `first_frame`.
        cost: minus the logarithm of the odds that they are one person rather than two strangers.
        margin: additional cost of the best alternative without this join [nat].
        decided: whether they were joined.
    """

    before: int
    after: int
    last_frame: int
    first_frame: int
    cost: float
    margin: float
    decided: bool


def fit_track_ends(
    number: int,
    frames: Integers,
    joints: Floats,
    views: Integers,
    fps: float,
    settings: TrackingSettings,
    cameras: int,
) -> tuple[End, End]:
    """Return the start and the end of a track of a rig's `cameras`.

    Frames (n,) are those whose rays determined the position, joints (n, 17, 3) [m], world, NaN
    where not determined. Of more than two cameras, the limbs of two views (n,) are not used, as one
    of them may show somebody else.
    """
    torso, whole = _mean_known(joints[:, COCO17_TORSO]), _mean_known(joints)
    places = np.where(np.isfinite(torso), torso, whole)
    limbs, variance = limb_lengths(joints[views >= min(settings.birth_views, cameras)], fps)
    out = []
    for edge in (0, -1):
        near = np.abs(frames - frames[edge]) <= settings.end_time_s * fps
        time = (frames[near] - frames[edge]) / fps
        place, velocity = places[edge], np.full(2, np.nan)
        if np.count_nonzero(near) >= 3:
            slope = np.polynomial.polynomial.polyfit(time, places[near], 1)
            place, velocity = slope[0], slope[1]
        out.append(End(number, int(frames[edge]), place, velocity, limbs, variance))
    return out[0], out[1]


def _mean_known(points: Floats) -> Floats:
    """Return the mean position (n, 2) of the known points among (n, points, 3); NaN without any."""
    known: Flags = np.isfinite(points[..., :1])
    total = np.where(known, points[..., :2], 0.0).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / known.sum(axis=1))


def join_costs(
    before: list[End], after: list[End], fps: float, area: float, settings: TrackingSettings
) -> Floats:
    """Return the cost (n, m) [nat] of joining tracks that end to tracks that begin.

    It is minus the log odds of one person; infinite where impossible. Between two sightings a
    person's velocity is a random walk: the expected start of the second track follows from the mean
    of both velocities, or from the first's if the second's is unknown, and its uncertainty grows
    with the gap. `area` is the ground on which people move [m^2].
    """
    costs = np.full((len(before), len(after)), np.inf)
    for i, old in enumerate(before):
        for j, new in enumerate(after):
            gap = (new.frame - old.frame) / fps
            if 0.0 < gap <= settings.max_join_gap_s:
                costs[i, j] = _join_cost(old, new, gap, area, settings)
    return costs


def _join_cost(old: End, new: End, gap: float, area: float, settings: TrackingSettings) -> float:
    """Return minus the log odds that two ends `gap` [s] apart are one person."""
    offset = new.place - old.place
    place_noise = 0.1  # Standard deviation of a position from few frames [m].
    # Highest speed of a person [m/s].
    if np.linalg.norm(offset) > 9.5 * gap + 3.0 * place_noise:
        return math.inf
    first = np.nan_to_num(old.velocity)
    both = bool(np.isfinite(new.velocity).all())
    change = new.velocity - first
    memory = settings.velocity_memory_s
    short = min(gap, memory)
    mean = 0.5 * (first + new.velocity) if both else first
    offset = offset - mean * memory * (1.0 - math.exp(-gap / memory))
    prior, likelihood = [], []
    velocity_noise = 0.5  # Standard deviation of a velocity from few frames [m/s].
    for share, pace in settings.paces:
        agility, speed = pace * settings.velocity_change_std_m_s, pace * settings.rms_speed_m_s
        variance = place_noise**2 + agility**2 * short**3 / (12.0 if both else 3.0)
        variance += 2.0 * speed**2 * memory * (gap - short)
        prior.append(math.log(share) + _log_normal_density(first, speed**2 + velocity_noise**2))
        likelihood.append(prior[-1] + _log_normal_density(offset, variance))
        if both:
            spread = velocity_noise**2 + agility**2 * short
            likelihood[-1] += _log_normal_density(change, spread)
    odds = float(np.logaddexp.reduce(likelihood) - np.logaddexp.reduce(prior)) + math.log(area)
    if both:
        odds -= _log_normal_density(change, velocity_noise**2 + 2.0 * settings.rms_speed_m_s**2)
    # Who is out of sight for long may have walked anywhere.
    stale = (gap / settings.place_memory_s) ** 2
    anywhere = math.log(-math.expm1(-stale)) if stale > 0.0 else -math.inf
    odds = float(np.logaddexp(odds - stale, anywhere))
    return -odds - _shape_odds(old, new, settings)


def _shape_odds(old: End, new: End, settings: TrackingSettings) -> float:
    """Return the log odds by limb lengths that two tracks are one person: by size and proportions.

    People differ by size most: all limbs are longer or shorter. Errors of limbs are independent,
    so that the mean difference is known far better than each.
    """
    difference = new.limbs - old.limbs
    known = np.isfinite(difference)
    if not known.any():
        return 0.0
    difference, variance = difference[known], (old.limb_variance + new.limb_variance)[known]
    # Difference of one limb from the others beyond which it is a gross error [m].
    apart = (difference - np.median(difference)) / 0.05
    weight = 1.0 / (1.0 + apart**2)
    weight /= weight.sum()
    size = float(weight @ difference)
    own = settings.size_noise_m**2 + float(weight**2 @ variance)
    other = own + 2.0 * settings.size_std_m**2
    odds = 0.5 * (math.log(other / own) + size**2 / other - size**2 / own)
    rest, noise = difference - size, settings.limb_noise_m**2 + variance
    spread = noise + 2.0 * settings.limb_std_m**2
    evidence = _log_limb_density(rest, noise) - _log_limb_density(rest, spread)
    # The limbs of both sides are alike: their mean is worth four limbs.
    return odds + 4.0 * float(evidence.mean())


def _log_limb_density(difference: Floats, variance: Floats) -> Floats:
    """Return the log density of differences of lengths (n,) [m], some of which are gross errors.

    If two views place an elbow at another person's arm, a limb becomes a metre longer.
    """
    # Standard deviation of these gross errors [m].
    wide = variance + 0.3**2
    gross_share = 0.1  # Share of a track's limb lengths that are gross errors [1].
    usual = math.log1p(-gross_share) - 0.5 * (difference**2 / variance + np.log(variance))
    gross = math.log(gross_share) - 0.5 * (difference**2 / wide + np.log(wide))
    return np.asarray(np.logaddexp(usual, gross))


def _log_normal_density(offset: Floats, variance: float) -> float:
    """Return the log density of a normal distribution in the plane."""
    return -0.5 * float(offset @ offset) / variance - math.log(2.0 * math.pi * variance)


def choose_joins(
    before: list[End], after: list[End], costs: Floats, fps: float, settings: TrackingSettings
) -> list[Candidate]:
    """Return the joins of the likeliest assignment, each with its margin, cheapest first.

    A join is decided if its odds against every alternative are at least `join_odds`; a person
    reviews the others.

    Args:
        before: n tracks that end.
        after: m tracks that begin.
        costs: (n, m) [nat].
        fps: frames per second [1/s].
        settings: odds that decide.
    """
    sure = math.log(settings.join_odds)
    overrated = math.log(3.0)  # odds of motion in piles, where the people nearby are in reach [nat]
    gaps = np.subtract.outer([-end.frame for end in before], [-end.frame for end in after]) / fps
    newcomer = np.minimum(settings.newcomer_odds * np.maximum(gaps, 1.0) ** 2, 1.0)
    gain = np.minimum(costs + np.log(newcomer), 0.0)
    row, column = np.flatnonzero((gain < 0.0).any(1)), np.flatnonzero((gain < 0.0).any(0))
    gain = gain[np.ix_(row, column)]
    chosen, best = _cheapest_assignment(gain)
    joins = []
    for i, j in chosen:
        kept = gain[i, j]
        gain[i, j] = 0.0
        margin = _cheapest_assignment(gain)[1] - best
        gain[i, j] = kept
        old, new = before[row[i]], after[column[j]]
        cost, gap = float(costs[row[i], column[j]]), float(gaps[row[i], column[j]])
        # The share of people whose place after this time unseen follows from their motion.
        fresh = math.exp(-((gap / settings.place_memory_s) ** 2))
        needed = sure + overrated * fresh
        joins.append(
            Candidate(
                old.number, new.number, old.frame, new.frame, cost, float(margin), margin >= needed
            )
        )
    return sorted(joins, key=lambda join: (join.cost, join.before))


def _cheapest_assignment(gain: Floats) -> tuple[list[tuple[int, int]], float]:
    """Return the pairs of the cheapest assignment and its cost; an unpaired track costs nothing."""
    row, column = linear_sum_assignment(gain)
    used = gain[row, column] < 0.0
    pairs = list(zip(row[used].tolist(), column[used].tolist(), strict=True))
    return pairs, float(gain[row, column].sum())


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

    @property
    def join(self) -> Join:
        """The person's own track before and after, of which either is as likely the other's."""
        return Join(
            before=self.person,
            after=self.person,
            last_frame=self.frame - 1,
            first_frame=self.frame,
            cost=0.0,
            margin=0.0,
            decided=True,
        )


def identity_certainty(joins: Iterable[Join], person: NDArray[np.integer], frames: int) -> Floats:
    """Return the probability (frames, people) that the tracked person is still the first one [1].

    The tracks of a person are joined by odds: a stretch between two joins has the probability of
    all joins before it, each against its best alternative, and of a half after a takeover. It is 1
    up to the first join, and after a join that a reviewer made.

    Args:
        joins: joins of the clip, decided or not.
        person: (people,) ids.
        frames: number of the clip's frames.
    """
    certainty = np.ones((frames, len(person)))
    for join in joins:
        if join.decided and join.before == join.after and join.margin is not None:
            later = certainty[join.first_frame :, person == join.before]
            certainty[join.first_frame :, person == join.before] = later / (
                1.0 + math.exp(-join.margin)
            )
    return certainty


def find_takeovers(
    people: Sequence[Person], frame: int, index: Integers, affinity: Floats
) -> list[Takeover]:
    """Return people who, after a gap, took a detection that another person lost in this frame.

    Whether the other person is located again is not known yet. The n people are followed, before
    this frame's update. The matched detections `index` are (cameras, n), -1 = none, the affinity
    (cameras, n, detections), minus infinity beyond the gates.
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
    """Return takeovers after which a real person was never located again, by final numbers."""
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
    frames: Integers, people: int, takeovers: Sequence[Takeover], joins: Sequence[Join]
) -> str | None:
    """Return a warning about ambiguous identities of a clip, of frames (frames,); None if few.

    Takeovers are by indices of frames in the clip, joins decided or not.
    """
    parts = []
    max_named = 3  # Most doubts that the warning names one by one.
    if takeovers:
        named = [
            f"person {each.person}"
            + (f" and person {each.other}" if each.other >= 0 else "")
            + f" in frame {frames[each.frame]}"
            for each in takeovers[:max_named]
        ]
        parts.append(
            f"{_count_noun(len(takeovers), 'track')} may have passed from one person to another "
            f"where one of them is hidden from a camera ({_list_named(named, len(takeovers))})"
        )
    undecided = [join for join in joins if not join.decided]
    # Undecided joins per person [1] up to which a run does not warn.
    if len(undecided) > 0.2 * people:
        named = [
            f"person {join.before} until frame {frames[join.last_frame]} and person {join.after} "
            f"from frame {frames[join.first_frame]}"
            for join in undecided[:max_named]
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
