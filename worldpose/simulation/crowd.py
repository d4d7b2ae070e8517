"""People in motion: paths with physical contact, and all people at any camera's times.

At corner kicks and when people run through each other, every person steers for a target within
limits of speed and acceleration; a person on a collision course passes in contact, and contact
pushes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.football import play
from worldpose.simulation.gait import tread
from worldpose.simulation.motions import Action, jump
from worldpose.simulation.paths import MARGIN, STEP, Clip, GroundPath, stand_about, wander
from worldpose.simulation.recordings import clip_path
from worldpose.simulation.settings import CrowdSettings, Scenario
from worldpose.simulation.skeletons import Body, PosedBody, draw_body, solve_body

TOUCH: Final = 0.48
"""Distance between the middles of people whose bodies begin to touch [m]: chests and shoulders are
0.25 to 0.5 m thick, and arms are spread."""
PUSH: Final = 60.0
"""Acceleration that separates two coincident bodies [m/s^2]; less overlap pushes less."""
FORESIGHT: Final = 0.6
"""Time ahead at which people see a collision [s]."""
CLOSING: Final = 1.5
"""Closing speed below which people lean in instead of passing [m/s]."""
DODGE: Final = 15.0
"""Lateral acceleration on an exact collision course [m/s^2]; a pass in contact needs none."""
BRAKE: Final = 6.0
"""Rate at which bodies in contact lose speed relative to each other [1/s]: they hold and lean on
one another."""
ACCELERATION: Final = 5.0
"""Maximum acceleration and braking by a person's own legs [m/s^2]."""
SHOVED: Final = 20.0
"""Maximum in all, pushed by others [m/s^2]: a body check takes 2 m/s in 0.1 s."""
REACTION: Final = 0.25
"""Time constant of a wished change of velocity [s]."""
KEEN: Final = 2.5
"""Desired speed per metre to the target [1/s]."""
TURN_TIME: Final = 0.15
"""Time constant of a body's turn to its direction of movement or gaze [s]."""
TURN_RATE: Final = 6.0
"""Maximum turn rate of a body [rad/s]."""
FACING_SPEED: Final = 1.0
"""Slower people face the ball and step aside or back [m/s]."""

FIRST_BALL: Final = 1.8
"""Time at which the first ball comes down [s]."""
BALL_EVERY: Final = 5.0
"""Interval between balls in longer clips [s]."""
PACKS: Final = 3
"""Groups of attackers who wait for the ball, an arm's length apart."""
FEINT_TIME: Final = (0.5, 1.3)
"""Time between an attacker's feints [s]."""
FEINT: Final = 0.6
"""Length of a feint along each axis [m], standard deviation."""
MARKED: Final = 0.35
"""Distance at which a defender marks an attacker, towards the goal [m]: in contact."""
BESIDE: Final = 0.1
"""Desired lateral distance of pairs of runners [m]; shoulders keep them farther apart."""
JUMP_REACH: Final = 2.2
"""People nearer to the falling ball jump for it [m]."""
JUMP_TOP: Final = 0.9
"""Time from the crouch to the top of a jump [s]."""

Wish = Callable[[int, Floats, Floats], tuple[Floats, Floats, Floats]]
"""Targets (people, 2) [m], top speeds (people,) [m/s] and what people face (2,) or (people, 2) [m],
from the sample's number, positions and velocities (people, 2)."""


def take_corner(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> list[GroundPath]:
    """Return paths at corner kicks: pairs in contact, feints, a rush to the ball, jumps.

    The last person keeps the goal; of the others, every second one attacks and the next marks that
    attacker. The goal is at the end of the area that is farther from the halfway line.

    Args:
        crowd: people, area and fastest speed.
        duration: time covered besides the margins [s].
        rng: draws everything.
    """
    time = _sample_times(duration)
    count, center = crowd.people, np.array(crowd.area_center_m)
    half = 0.5 * np.array(crowd.area_size_m)
    out = 1.0 if center[0] >= 0.0 else -1.0
    goal = np.array([center[0] + out * half[0], 0.0])
    corner = np.array([goal[0], rng.choice([-1.0, 1.0]) * 34.0])
    attackers = np.arange(0, count - 1, 2)
    markers = np.arange(1, count - 1, 2)

    packs = center + half * rng.uniform([-0.5, -0.6], [0.3, 0.6], (PACKS, 2)) * [out, 1.0]
    homes = packs[rng.integers(PACKS, size=len(attackers))]
    homes = homes + 1.0 * rng.standard_normal(homes.shape)
    feints = FEINT * _draw_steps(time, len(attackers), rng)
    balls = np.arange(FIRST_BALL, time[-1], BALL_EVERY)
    drops = goal + rng.uniform([3.5, -5.0], [8.0, 5.0], (len(balls), 2)) * [-out, 1.0]
    around = rng.standard_normal((len(balls), len(attackers), 2))
    # Half of them go for the ball, others for a post and the edge of the area.
    around *= np.where(rng.random((len(balls), len(attackers), 1)) < 0.5, 0.4, 2.5)

    def wish(sample: int, position: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
        target, top = position.copy(), np.full(count, crowd.speed_m_s[1])
        coming = np.flatnonzero((time[sample] > balls - 1.2) & (time[sample] < balls + 0.5))
        target[attackers] = homes + feints[sample]
        top[attackers] = 2.0
        look = corner
        if len(coming):
            ball = int(coming[-1])
            target[attackers] = drops[ball] + around[ball]
            top[attackers] = crowd.speed_m_s[1]
            look = drops[ball] if time[sample] > balls[ball] - 0.6 else corner
        his = attackers[: len(markers)]
        toward = _unit(goal - position[his])
        target[markers] = position[his] + MARKED * toward + REACTION * velocity[his]
        if count:
            target[count - 1] = goal - [out * 0.8, 0.0]
            target[count - 1, 1] += 0.15 * look[1] if abs(look[1]) < 10.0 else 0.0
        return target, top, look

    start = np.empty((count, 2))
    start[attackers] = homes
    start[markers] = homes[: len(markers)] + 0.5 * _unit(goal - homes[: len(markers)])
    if count:
        start[count - 1] = goal - [out * 0.8, 0.0]
    paths = _follow(time, start, wish)
    return [
        GroundPath(path.time, path.position, path.heading, path.speed, jumps)
        for path, jumps in zip(paths, _draw_jumps(paths, balls, drops, rng), strict=True)
    ]


def run_through(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> list[GroundPath]:
    """Return paths of people who run through the area's middle and back, half of them in pairs.

    Args:
        crowd: people, area and speeds.
        duration: time covered besides the margins [s].
        rng: draws everything.
    """
    time = _sample_times(duration)
    count, center = crowd.people, np.array(crowd.area_center_m)
    reach = 0.5 * float(min(crowd.area_size_m))
    angle = 2.0 * np.pi * np.arange(count) / max(count, 1) + rng.uniform(-0.3, 0.3, count)
    partners = np.arange(1, 2 * (count // 4), 2)  # each runs next to the previous person
    angle[partners] = angle[partners - 1] + 0.06
    speed = rng.uniform(0.5 * sum(crowd.speed_m_s), crowd.speed_m_s[1], count)
    # Pairs that fight for the path are slower.
    speed[partners - 1] = rng.uniform(crowd.speed_m_s[0], 0.5 * sum(crowd.speed_m_s), len(partners))
    miss = 0.35 * rng.standard_normal((count, 2))
    state = angle.copy()

    def wish(sample: int, position: Floats, velocity: Floats) -> tuple[Floats, Floats, Floats]:
        ahead = center + miss - reach * np.stack([np.cos(state), np.sin(state)], axis=-1)
        there = np.linalg.norm(ahead - position, axis=-1) < 1.5
        state[there] += np.pi + 0.5 * np.sin(7.0 * state[there])
        aside = _unit(np.stack([-velocity[:, 1], velocity[:, 0]], axis=-1))
        ahead[partners] = position[partners - 1] + BESIDE * aside[partners - 1]
        ahead[partners] += velocity[partners - 1] / KEEN  # the follower aims ahead to keep up
        top = speed.copy()
        top[partners] = crowd.speed_m_s[1] + 1.0
        return ahead, top, center

    start = center + reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return _follow(time, start, wish)


def _sample_times(duration: float) -> Floats:
    samples = round((duration + 2.0 * MARGIN) / STEP) + 1
    return np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)


def _follow(time: Floats, start: Floats, wish: Wish) -> list[GroundPath]:
    """Return paths of people (n) from their starts (n, 2) [m] to their targets, with contact."""
    count = len(start)
    position, velocity = start.copy(), np.zeros((count, 2))
    heading = np.zeros(count)
    places, headings = np.empty((len(time), count, 2)), np.empty((len(time), count))
    speeds = np.empty((len(time), count))
    for i in range(len(time)):
        target, top, look = wish(i, position, velocity)
        way = target - position
        far = np.linalg.norm(way, axis=-1, keepdims=True)
        wished = way * np.minimum(KEEN, top[:, None] / np.maximum(far, 1e-9))
        drive = (wished - velocity) / REACTION
        size = np.linalg.norm(drive, axis=-1, keepdims=True)
        drive = drive * np.minimum(1.0, ACCELERATION / np.maximum(size, 1e-9))

        apart, passing = position[:, None] - position, velocity[:, None] - velocity
        gap = np.linalg.norm(apart, axis=-1) + 1e-9
        close = np.clip(1.0 - gap / TOUCH, 0.0, 1.0)
        np.fill_diagonal(close, 0.0)
        pushed = PUSH * (apart * (close / gap)[..., None]).sum(axis=1)
        touching = np.minimum(4.0 * close, 1.0)[..., None]
        held = -BRAKE * (touching * passing).sum(axis=1)
        meet = -(apart * passing).sum(axis=-1) / np.maximum((passing**2).sum(axis=-1), 1e-9)
        nearest = apart + passing * np.clip(meet, 0.0, FORESIGHT)[..., None]
        miss = np.linalg.norm(nearest, axis=-1) + 1e-9
        urgent = np.clip(1.0 - miss / TOUCH, 0.0, 1.0)
        urgent[(meet <= 0.0) | ((passing**2).sum(axis=-1) < CLOSING**2)] = 0.0
        dodged = DODGE * (nearest * (urgent / miss)[..., None]).sum(axis=1)

        change = drive + pushed + held + dodged
        size = np.linalg.norm(change, axis=-1, keepdims=True)
        velocity = velocity + change * np.minimum(1.0, SHOVED / np.maximum(size, 1e-9)) * STEP
        places[i], speeds[i] = position, np.linalg.norm(velocity, axis=-1)
        facing = np.where(speeds[i][:, None] > FACING_SPEED, velocity, look - position)
        turn = np.arctan2(facing[:, 1], facing[:, 0]) - heading
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        heading = heading + (
            turn if i == 0 else np.clip(turn / TURN_TIME, -TURN_RATE, TURN_RATE) * STEP
        )
        headings[i] = heading
        position = position + velocity * STEP
    return [GroundPath(time, places[:, n], headings[:, n], speeds[:, n]) for n in range(count)]


def _draw_jumps(
    paths: list[GroundPath], balls: Floats, drops: Floats, rng: np.random.Generator
) -> list[tuple[Action, ...]]:
    """Return jumps of each person near a falling ball."""
    leaps = []
    for path in paths:
        own = []
        for when, drop in zip(balls, drops, strict=True):
            place = [float(np.interp(when, path.time, axis)) for axis in path.position.T]
            late, rise = rng.uniform(-0.1, 0.15), rng.uniform(0.25, 0.42)
            if np.hypot(*(place - drop)) < JUMP_REACH:
                own.append(Action(when + late - JUMP_TOP, jump(rise), left=rng.random() < 0.5))
        leaps.append(tuple(own))
    return leaps


def _draw_steps(time: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Return standard normal steps (samples, count, 2), constant for a random feint time each."""
    steps = np.empty((len(time), count, 2))
    for person in range(count):
        intervals = int((time[-1] - time[0]) / FEINT_TIME[0]) + 2
        ends = time[0] + np.cumsum(rng.uniform(FEINT_TIME[0], FEINT_TIME[1], intervals))
        steps[:, person] = rng.standard_normal((len(ends) + 1, 2))[np.searchsorted(ends, time)]
    return steps


def _unit(vectors: Floats) -> Floats:
    unit: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    return unit


CONTESTS: Final = {"corner": take_corner, "crossing": run_through}
"""Movements in which people make contact."""


@dataclass(frozen=True, eq=False)
class Crowd:
    """All people on the pitch.

    Attributes:
        bodies: measures of each person.
        paths: path of each person.
        action: (samples, 2) [m], world; the point that people and the broadcast camera follow.
        action_times: (samples,) [s].
    """

    bodies: Sequence[Body]
    paths: Sequence[GroundPath]
    action: Floats
    action_times: Floats
    pitch: PitchTemplate
    gaits: Sequence[np.random.SeedSequence]

    def joints(self, times: Floats) -> Floats:
        """Return joints (frames, persons, 17, 3) [m], world, at `times` [s]; repeatable."""
        joints = np.empty((len(times), len(self.paths), 17, 3))
        for person in range(len(self.paths)):
            joints[:, person] = self._solve_person(person, times).keypoints()
        return joints

    def poses(self, times: Floats) -> BodyParameters:
        """Return the bodies (persons, frames), whose keypoints are the people's joints."""
        shape = (len(self.paths), len(times))
        betas, orient, transl = np.empty((*shape, 10)), np.empty((*shape, 3)), np.empty((*shape, 3))
        angles = np.empty((*shape, BODY_POSE))
        for person in range(len(self.paths)):
            body = self._solve_person(person, times).parameters()
            betas[person], orient[person] = body.betas, body.global_orient
            angles[person], transl[person] = body.body_pose, body.transl
        return BodyParameters(betas, orient, angles, transl)

    def _solve_person(self, person: int, times: Floats) -> PosedBody:
        body, rng = self.bodies[person], np.random.default_rng(self.gaits[person])
        joints, courses = tread(body, self.paths[person], times, self.pitch.height, rng)
        return solve_body(body.figure, joints, self.pitch.height, courses)

    @property
    def heights(self) -> Floats:
        """Return body heights (persons,) [m]."""
        return np.array([body.height for body in self.bodies])


def gather(
    scenario: Scenario,
    pitch: PitchTemplate,
    seed: np.random.SeedSequence,
    driven: Sequence[GroundPath] | None = None,
    clip: Clip | None = None,
) -> Crowd:
    """Return the people of a scenario.

    Args:
        scenario: people, place and duration.
        pitch: the ground under them.
        seed: every person draws from a separate stream; only football couples the paths.
        driven: paths from tracking data, one per person.
        clip: motion capture that the third person plays, the first who is no goalkeeper, or the
            last of fewer.
    """
    settings = scenario.crowd
    count = settings.people if driven is None else len(driven)
    person_seeds = seed.spawn(count)
    generators = [np.random.default_rng(each) for each in person_seeds]
    bodies = [draw_body(settings.height_m, rng) for rng in generators]
    paths: list[GroundPath] = []
    action = None
    if driven is not None:
        paths = list(driven)
    elif settings.movement == "football":
        (game,) = seed.spawn(1)
        paths, ball = play(settings, scenario.duration, np.random.default_rng(game))
        action = ball.position
    elif settings.movement in CONTESTS:
        (contest,) = seed.spawn(1)
        paths = CONTESTS[settings.movement](
            settings, scenario.duration, np.random.default_rng(contest)
        )
    else:
        for rng in generators:
            paths.append(wander(settings, scenario.duration, paths, rng))
    times = paths[0].time if paths else np.array([0.0, scenario.duration])
    if action is None:
        action = np.broadcast_to(np.array(settings.area_center_m), (len(times), 2))
        if paths:
            action = np.mean([path.position for path in paths], axis=0)
    if clip is not None and paths:
        actor = min(2, count - 1)
        paths[actor] = clip_path(clip, paths[actor], bodies[actor])
    gaits, moods = (
        zip(*(each.spawn(2) for each in person_seeds), strict=True) if count else ((), ())
    )
    paths = [
        stand_about(path, settings.actions, np.random.default_rng(mood))
        for path, mood in zip(paths, moods, strict=True)
    ]
    return Crowd(bodies, paths, action, times, pitch, gaits)
