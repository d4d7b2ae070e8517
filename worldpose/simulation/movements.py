"""Movements of people over the pitch: everyone steers for a target, and bodies touch.

The movements of a scenario differ in their targets alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from scipy.interpolate import interp1d
from scipy.ndimage import gaussian_filter1d

from data_contracts.arrays import Flags, Floats
from worldpose.geometry.rigid import unit
from worldpose.simulation.paths import STEP, GroundPath, drift, sample_times
from worldpose.simulation.settings import CrowdSettings

REACTION: Final = 0.25
"""Time constant of a wished change of velocity [s]."""
KEEN: Final = 2.5
"""Maximum speed per metre to the target [1/s]."""
TOP_SPEED: Final = 9.2
"""[m/s]"""

Wish = Callable[[int, Floats, Floats], tuple[Floats, Floats, Floats]]
"""Targets (people, 2) [m], top speeds (people,) [m/s] and what people face (2,) or (people, 2) [m],
from the sample's number, positions and velocities (people, 2)."""


def _steer(
    time: Floats, start: Floats, wish: Wish, space: float = 0.0, yields: Flags | None = None
) -> list[GroundPath]:
    """Return paths of people (n) from their starts (n, 2) [m] to their targets.

    `time` (samples,) is of `sample_times`. People make way for each other below the distance
    `space` [m]; `yields` (n, n) tells whether a person heeds another one, None = all do.
    """
    turn_time = 0.15  # time constant of a body's turn to its direction of movement or gaze [s]
    turn_rate = 6.0  # maximum turn rate of a body [rad/s]
    count = len(start)
    heeds = ~np.eye(count, dtype=bool) if yields is None else yields
    position, velocity = start.copy(), np.zeros((count, 2))
    places, headings = np.empty((len(time), count, 2)), np.empty((len(time), count))
    heading = np.zeros(count)
    facing_speed = 0.8  # slower people face the ball and step aside or back [m/s]
    for i in range(len(time)):
        target, top, look = wish(i, position, velocity)
        change = _accelerate(position, velocity, target - position, top, space, heeds)
        velocity = velocity + change * STEP
        fast = np.linalg.norm(velocity, axis=-1, keepdims=True) > facing_speed
        facing = np.where(fast, velocity, look - position)
        turn = np.arctan2(facing[:, 1], facing[:, 0]) - heading
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        rate = np.clip(turn / turn_time, -turn_rate, turn_rate)
        heading = heading + (turn if i == 0 else rate * STEP)
        places[i], headings[i] = position, heading
        position = position + velocity * STEP
    smoothing = 0.06  # of paths in time, standard deviation [s]: acceleration takes a moment
    places = gaussian_filter1d(places, smoothing / STEP, axis=0, mode="nearest")
    speeds = np.linalg.norm(np.gradient(places, STEP, axis=0), axis=-1)
    return [GroundPath(time, places[:, n], headings[:, n], speeds[:, n]) for n in range(count)]


def _accelerate(
    position: Floats, velocity: Floats, way: Floats, top: Floats, space: float, heeds: Flags
) -> Floats:
    """Return accelerations (people, 2) [m/s^2] by legs and by contact."""
    shoved = 20.0  # maximum in all, pushed by others [m/s^2]: a body check takes 2 m/s in 0.1 s
    acceleration = 5.0  # of a person's legs at most [m/s^2]; forward none at `TOP_SPEED`
    make_way = 5.0  # speed wished away from a person in the same place [m/s]; farther away less
    brake = 6.0  # rate at which bodies in contact lose relative speed [1/s]: they hold and lean
    dodge = 15.0  # sideways on an exact collision course [m/s^2]; a pass in contact needs none
    closing = 1.5  # closing speed below which people lean in instead of passing [m/s]
    foresight = 0.6  # time ahead at which people see a collision [s]
    push = 60.0  # apart, of two coincident bodies [m/s^2]; less overlap pushes less
    # Distance between the middles of people whose bodies begin to touch [m]: chests and
    # shoulders are 0.25 to 0.5 m thick, and arms are spread.
    touch = 0.48
    apart, passing = position[:, None] - position, velocity[:, None] - velocity
    gap = np.linalg.norm(apart, axis=-1) + 1e-9
    far = np.linalg.norm(way, axis=-1, keepdims=True)
    wished = way * np.minimum(KEEN, top[:, None] / np.maximum(far, 1e-9))
    if space > 0.0:
        near = heeds * np.clip(1.0 - gap / space, 0.0, 1.0)
        wished = wished + make_way * (apart * (near / gap)[..., None]).sum(axis=1)
    drive = (wished - velocity) / REACTION
    # The limit of driving forces falls with speed, the limit of braking and turning does not.
    speed = np.linalg.norm(velocity, axis=-1)
    ahead = velocity / np.maximum(speed, 1e-9)[:, None]
    forward = (drive * ahead).sum(-1)
    limit = acceleration * np.maximum(1.0 - speed / TOP_SPEED, 0.0)
    drive = drive + (np.minimum(forward, limit) - forward)[:, None] * ahead
    drive = _limit(drive, acceleration)

    close = heeds * np.clip(1.0 - gap / touch, 0.0, 1.0)
    pushed = push * (apart * (close / gap)[..., None]).sum(axis=1)
    touching = np.minimum(4.0 * close, 1.0)[..., None]
    held = -brake * (touching * passing).sum(axis=1)
    meet = -(apart * passing).sum(axis=-1) / np.maximum((passing**2).sum(axis=-1), 1e-9)
    nearest = apart + passing * np.clip(meet, 0.0, foresight)[..., None]
    miss = np.linalg.norm(nearest, axis=-1) + 1e-9
    urgent = heeds * np.clip(1.0 - miss / touch, 0.0, 1.0)
    urgent[(meet <= 0.0) | ((passing**2).sum(axis=-1) < closing**2)] = 0.0
    dodged = dodge * (nearest * (urgent / miss)[..., None]).sum(axis=1)
    return _limit(drive + pushed + held + dodged, shoved)


def _limit(vectors: Floats, most: float) -> Floats:
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, most / np.maximum(size, 1e-9)))


def wander(
    crowd: CrowdSettings, duration: float, rngs: Sequence[np.random.Generator]
) -> list[GroundPath]:
    """Return paths of people who go from goal to goal in the area with changing speed.

    `duration` [s] is covered besides the margins. People heed earlier ones alone and have a
    generator each, so that an additional person changes no earlier path.
    """
    arrived = 1.5  # A wandering person that near a goal goes for the next one [m]
    start_space = 2.5  # between people at the start of their paths [m], where there is room
    time, count = sample_times(duration), len(rngs)
    center, half = np.array(crowd.area_center_m), 0.5 * np.array(crowd.area_size_m)
    low, high = crowd.speed_m_s
    most = 2 * round(time[-1] - time[0])
    starts, goals = np.empty((0, 2)), np.empty((count, most, 2))
    pace = np.empty((count, len(time)))
    goal_area = 1.25  # size of the area of goals [people's area]: people reach its border
    for person, rng in enumerate(rngs):
        drawn = center + half * rng.uniform(-1.0, 1.0, (50, 2))
        clear = np.linalg.norm(drawn[:, None] - starts, axis=-1).min(axis=1, initial=np.inf)
        # The first with room, else the best.
        start = drawn[[int(np.argmax(np.minimum(clear, start_space)))]]
        starts = np.concatenate([starts, start])
        goals[person] = center + goal_area * half * rng.uniform(-1.0, 1.0, (most, 2))
        period = rng.uniform(4.0, 9.0)
        angle = 2.0 * np.pi * (time[:, None] / (period, 0.6 * period) + rng.random(2))
        wave = 0.5 + 0.5 * np.sin(angle) @ np.array([0.65, 0.35])
        pace[person] = np.maximum(low + (high - low) * wave, 0.0)
    number = np.zeros(count, dtype=int)

    def wish(sample: int, position: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
        target = goals[np.arange(count), number % most]
        number[np.linalg.norm(target - position, axis=-1) < arrived] += 1
        return target, pace[:, sample], target

    return _steer(time, starts, wish, 1.5 * crowd.personal_space_m, np.tri(count, k=-1, dtype=bool))


def take_corner(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> list[GroundPath]:
    """Return paths at corner kicks: pairs in contact, feints, a rush to the ball.

    The last person keeps the goal; of the others, every second one attacks and the next marks that
    attacker. The goal is at the end of the area that is farther from the halfway line.
    """
    feint = 0.6  # length of a feint along each axis [m], standard deviation
    ball_every = 5.0  # interval between balls in longer clips [s]
    first_ball = 1.8  # time at which the first ball comes down [s]
    time = sample_times(duration)
    count, center = crowd.people, np.array(crowd.area_center_m)
    half = 0.5 * np.array(crowd.area_size_m)
    out = 1.0 if center[0] >= 0.0 else -1.0
    goal = np.array([center[0] + out * half[0], 0.0])
    corner = np.array([goal[0], rng.choice([-1.0, 1.0]) * 34.0])
    attackers, markers = np.arange(0, count - 1, 2), np.arange(1, count - 1, 2)

    pack_count = 3  # groups of attackers who wait for the ball, an arm's length apart
    packs = center + half * rng.uniform([-0.5, -0.6], [0.3, 0.6], (pack_count, 2)) * [out, 1.0]
    homes = packs[rng.integers(pack_count, size=len(attackers))]
    homes = homes + 1.0 * rng.standard_normal(homes.shape)
    feints = feint * _draw_steps(time, len(attackers), rng)
    balls = np.arange(first_ball, time[-1], ball_every)
    drops = goal + rng.uniform([3.5, -5.0], [8.0, 5.0], (len(balls), 2)) * [-out, 1.0]
    around = rng.standard_normal((len(balls), len(attackers), 2))
    # Half of them go for the ball, others for a post and the edge of the area.
    around *= np.where(rng.random((len(balls), len(attackers), 1)) < 0.5, 0.4, 2.5)

    def wish(sample: int, position: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
        target, top = position.copy(), np.full(count, crowd.speed_m_s[1])
        coming = np.flatnonzero((time[sample] > balls - 1.2) & (time[sample] < balls + 0.5))
        target[attackers] = homes + feints[sample]
        look = corner
        if len(coming):
            ball = int(coming[-1])
            target[attackers] = drops[ball] + around[ball]
            look = drops[ball] if time[sample] > balls[ball] - 0.6 else corner
        else:
            top[attackers] = 2.0
        marked = attackers[: len(markers)]
        toward = unit(goal - position[marked])
        marking_distance = 0.35  # towards the goal [m]: in contact
        target[markers] = position[marked] + marking_distance * toward + REACTION * velocity[marked]
        if count:
            target[count - 1] = goal - [out * 0.8, 0.0]
            target[count - 1, 1] += 0.15 * look[1] if abs(look[1]) < 10.0 else 0.0
        return target, top, look

    start = np.tile(goal - [out * 0.8, 0.0], (count, 1))
    start[attackers] = homes
    start[markers] = homes[: len(markers)] + 0.5 * unit(goal - homes[: len(markers)])
    return _steer(time, start, wish)


def _draw_steps(time: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Return standard normal steps (samples, count, 2), constant for a random feint time each."""
    feint_time = (0.5, 1.3)  # time between an attacker's feints [s]
    steps = np.empty((len(time), count, 2))
    for person in range(count):
        intervals = int((time[-1] - time[0]) / feint_time[0]) + 2
        ends = time[0] + np.cumsum(rng.uniform(feint_time[0], feint_time[1], intervals))
        steps[:, person] = rng.standard_normal((len(ends) + 1, 2))[np.searchsorted(ends, time)]
    return steps


def run_through(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> list[GroundPath]:
    """Return paths of people who run through the area's middle and back, half of them in pairs."""
    beside = 0.1  # lateral distance that pairs want [m]; shoulders keep them farther apart
    count, center = crowd.people, np.array(crowd.area_center_m)
    reach = 0.5 * float(min(crowd.area_size_m))
    angle = 2.0 * np.pi * np.arange(count) / max(count, 1) + rng.uniform(-0.3, 0.3, count)
    partners = np.arange(1, 2 * (count // 4), 2)  # each runs next to the previous person
    angle[partners] = angle[partners - 1] + 0.06
    speed = rng.uniform(0.5 * sum(crowd.speed_m_s), crowd.speed_m_s[1], count)
    # Pairs that fight for the path are slower.
    speed[partners - 1] = rng.uniform(crowd.speed_m_s[0], 0.5 * sum(crowd.speed_m_s), len(partners))
    speed[partners] = crowd.speed_m_s[1] + 1.0
    miss = 0.35 * rng.standard_normal((count, 2))
    state = angle.copy()

    def wish(sample: int, position: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
        ahead = center + miss - reach * np.stack([np.cos(state), np.sin(state)], axis=-1)
        there = np.linalg.norm(ahead - position, axis=-1) < 1.5
        state[there] += np.pi + 0.5 * np.sin(7.0 * state[there])
        aside = unit(np.stack([-velocity[:, 1], velocity[:, 0]], axis=-1))
        ahead[partners] = position[partners - 1] + beside * aside[partners - 1]
        ahead[partners] += velocity[partners - 1] / KEEN  # the follower aims ahead to keep up
        return ahead, speed, center

    start = center + reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return _steer(sample_times(duration), start, wish)


FORMATION: Final = np.array(
    # goalkeeper, four defenders, three midfielders, three forwards
    [
        [-47.0, 0.0],
        *([-22.0, 21.0], [-25.0, 7.0], [-25.0, -7.0], [-22.0, -21.0]),
        *([-8.0, 13.0], [-11.0, 0.0], [-8.0, -13.0]),
        *([9.0, 19.0], [12.0, 0.0], [9.0, -19.0]),
    ]
)
"""Places of a 4-3-3 that attacks towards positive x, while the ball is at the centre spot [m]."""


def play(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> tuple[list[GroundPath], Floats]:
    """Return the paths of all people, players by team and then officials, and the ball's path.

    Players steer for their place in a formation that shifts with the ball (samples, 2) [m], the
    nearest of each team for the ball, a sprinter for open space, the referee for a place near play,
    assistants along the touch lines.
    """
    body_space = 1.3  # distance below which players make way for each other [m]
    stands = (2.0, 5.0)  # a player that near the target stands, until it is that far [m]
    eagerness = 0.38  # speed per metre to the target [1/s]: 10 m away a jog, 20 m a hard run
    pressing = 2  # players of each team who go for the ball: one on it, one in support
    time = sample_times(duration)
    players = max(crowd.people - crowd.officials, 0)
    team = np.arange(crowd.people) % 2
    side = np.where(team == 0, 1.0, -1.0)
    ball = _roll_ball(time, rng)
    targets, hurry = _draw_targets(time, ball, players, side, rng)
    moving = np.ones(crowd.people, dtype=bool)

    def wish(sample: int, position: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
        target = targets[sample].copy()
        for which in (0, 1):
            # Goalkeepers are the first two.
            mates = np.flatnonzero((team[:players] == which) & (np.arange(players) >= 2))
            far = np.linalg.norm(position[mates] - ball[sample], axis=-1)
            for rank, mate in enumerate(mates[np.argsort(far, kind="stable")[:pressing]]):
                target[mate] = ball[sample] - side[mate] * np.array([0.8 + 4.0 * rank, 0.5 * rank])
        far = np.linalg.norm(target - position, axis=-1)
        moving[:] = far > np.where(moving, *stands)
        pace = np.where(moving, eagerness * hurry[sample] * far, 0.0)
        return target, np.minimum(pace, TOP_SPEED), ball[sample]

    return _steer(time, targets[0], wish, body_space), ball


def _roll_ball(time: Floats, rng: np.random.Generator) -> Floats:
    """Return the places (samples, 2) [m] of a ball that goes from pass to pass in play."""
    pass_length = 12.0  # standard deviation of a pass per axis [m]
    pass_every = (2.0, 4.5)  # time between passes [s]
    when, places = [float(time[0])], [rng.uniform(-1.0, 1.0, 2) * [30.0, 18.0]]
    while when[-1] < time[-1]:
        when.append(when[-1] + rng.uniform(*pass_every))
        # Play drifts back to the middle third instead of staying in a corner.
        place = 0.9 * places[-1] + pass_length * rng.standard_normal(2)
        places.append(np.clip(place, [-46.0, -29.0], [46.0, 29.0]))
    straight = np.stack([np.interp(time, when, axis) for axis in np.array(places).T], axis=-1)
    # The target of people's gaze must not jump.
    return np.asarray(gaussian_filter1d(straight, 0.13 / STEP, axis=0, mode="nearest"))


def _draw_targets(
    time: Floats, ball: Floats, players: int, side: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return targets (samples, people, 2) [m], and by person a factor on the usual speed there."""
    sprint_time = 2.5  # planned duration of a sprint [s]
    sprint_every = 45.0  # mean time between a player's sprints [s]
    roam_time = 10.0  # correlation time of that drift [s]
    shape = (len(time), len(side))
    # One knot per second, without the jitter of a random walk in between.
    knots = np.arange(time[0], time[-1] + 2.0)
    drift_m = 8.0  # from the place in the formation, standard deviation per axis [m]
    roam = drift_m * drift((len(knots), shape[1], 2), roam_time, 1.0, rng)
    roam = interp1d(knots, roam, axis=0)(time)
    aims = rng.uniform([12.0, -10.0], [26.0, 10.0], (shape[1], 2))
    sprinting = np.zeros(shape, dtype=bool)
    for sample, person in np.argwhere(rng.random(shape) < STEP / sprint_every):
        sprinting[sample : sample + round(sprint_time / STEP), person] = True
    targets = np.empty((*shape, 2))
    # Formation shift along x and y relative to the ball's displacement [1]: teams stay compact.
    follow = np.array([0.60, 0.45])
    keeper_follow = np.array([0.12, 0.12])  # the same for goalkeepers [1]
    for person in range(shape[1]):
        role, own = (person // 2) % len(FORMATION), roam[:, person]
        if person == players:
            targets[:, person] = 0.9 * ball + [-4.0, 7.0] + 0.4 * own
        elif person > players:
            # An assistant keeps level with the last defender of the assistant's half.
            half = 1.0 if (person - players) % 2 else -1.0
            targets[:, person, 0] = half * np.clip(25.0 + half * follow[0] * ball[:, 0], 0.0, 50.0)
            targets[:, person, 1] = half * 35.2
        elif person < 2:
            targets[:, person] = side[person] * FORMATION[0] + keeper_follow * ball + 0.3 * own
        else:
            run = sprinting[:, person, None] * side[person] * aims[person]
            targets[:, person] = side[person] * FORMATION[role] + follow * ball + own + run
    return np.clip(targets, [-51.0, -35.5], [51.0, 35.5]), np.where(sprinting, 3.0, 1.0)
