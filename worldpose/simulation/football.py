"""Paths of footballers: two teams and officials who follow a ball, with bounded accelerations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d

from data_contracts.arrays import Floats
from worldpose.simulation.ball import roll_ball
from worldpose.simulation.duels import (
    AT_EASE,
    COASTING,
    PUSHING,
    STOPPING,
    Duels,
    in_order,
)
from worldpose.simulation.idling import keep_ready
from worldpose.simulation.paths import MARGIN, STEP, GroundPath
from worldpose.simulation.processes import drift
from worldpose.simulation.settings import CrowdSettings

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
FOLLOW: Final = np.array([0.60, 0.45])
"""Formation shift along x and y relative to the ball's displacement [1]: teams stay compact."""
KEEPER_FOLLOW: Final = np.array([0.12, 0.12])
"""The same for goalkeepers, who stay near their goal [1]."""
ROAM: Final = 8.0
"""Drift of players from their place in the formation [m], standard deviation per axis."""
ROAM_TIME: Final = 10.0
"""Correlation time of that drift [s]."""
PRESSING: Final = 2
"""Players of each team who go for the ball: one on it, one in support."""
SPRINT_EVERY: Final = 45.0
"""Mean time between a player's sprints [s]."""
SPRINT_TIME: Final = 2.5
"""Planned duration of a sprint [s]."""
TOP_SPEED: Final = (7.8, 9.2)
"""Range over players [m/s]."""
ACCELERATION: Final = 5.0
"""Maximum at a standstill, falling to zero at top speed; maximum in braking and turns [m/s^2]."""
REACTION: Final = 0.5
"""Time constant of a wished change of velocity [s]."""
JERK_TIME: Final = 0.12
"""Time constant of the acceleration [s]."""
EAGERNESS: Final = 0.38
"""Speed wished per metre to the target [1/s]: 10 m away they jog, 20 m away they run hard."""
NEAR_ENOUGH: Final = 2.0
"""A player that near the target stands [m], until the target is `WORTH_GOING` away."""
WORTH_GOING: Final = 5.0
"""[m]"""
BODY_SPACE: Final = 1.3
"""Distance below which players make way for each other [m]."""
TURN_TIME: Final = 0.15
"""Time constant of a body's turn to its direction of movement or gaze [s]."""
TURN_RATE: Final = 7.0
"""Maximum turn rate of a body [rad/s]."""


def play(
    crowd: CrowdSettings, duration: float, rng: np.random.Generator
) -> tuple[list[GroundPath], GroundPath]:
    """Return the paths of all people, players by team and then officials, and the path of the ball.

    Every person steers for a target that moves: players for their place in a formation that shifts
    with the ball, the nearest of each team for the ball, a sprinter for open space, the referee
    for a place near play, assistants along the touch lines. Targets need not be smooth: people
    accelerate within human bounds (docs/explanation/synthetic.md).

    Args:
        crowd: number of people and of officials among them.
        duration: time covered besides the margins [s].
        rng: draws play; the same for any number of cameras.
    """
    samples = round((duration + 2.0 * MARGIN) / STEP) + 1
    time = np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)
    players = max(crowd.people - crowd.officials, 0)
    team = np.arange(crowd.people) % 2
    side = np.where(team == 0, 1.0, -1.0)
    game = roll_ball(time, crowd.actions, rng)
    ball = game.position
    targets, hurry = _targets(time, ball, players, crowd.people, side, rng)
    top = rng.uniform(*TOP_SPEED, crowd.people)
    duels = Duels(time, game.touches, team, players, crowd.actions, rng)

    position, velocity = targets[0].copy(), np.zeros((crowd.people, 2))
    push, moving = np.zeros((crowd.people, 2)), np.ones(crowd.people, dtype=bool)
    look = ball[0] - position
    heading = np.arctan2(look[:, 1], look[:, 0])
    places = np.empty((samples, crowd.people, 2))
    speeds, headings = np.empty((2, samples, crowd.people))
    for i in range(samples):
        target = targets[i].copy()
        for which in (0, 1):
            mates = np.flatnonzero((team[:players] == which) & (np.arange(players) >= 2))
            far = np.linalg.norm(position[mates] - ball[i], axis=-1)
            for rank, mate in enumerate(mates[np.argsort(far, kind="stable")[:PRESSING]]):
                target[mate] = ball[i] - side[mate] * np.array([0.8 + 4.0 * rank, 0.5 * rank])
        haste = np.full(crowd.people, np.nan)
        for person, (place, left) in duels.advance(i, position, velocity, heading).items():
            target[person] = place
            haste[person] = np.linalg.norm(place - position[person]) / max(left, 0.3)
        mode = duels.mode[i]
        velocity, push, moving = _steer(
            position,
            velocity,
            push,
            moving,
            target - position,
            _Wishes(hurry[i], haste, np.minimum(duels.most[i], top), mode, duels.push[i]),
            top,
        )
        places[i], headings[i] = position, heading
        speeds[i] = np.linalg.norm(velocity, axis=-1)
        look = np.where(speeds[i][:, None] > 0.6, velocity, ball[i] - position)
        turn = np.arctan2(look[:, 1], look[:, 0]) - heading
        turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
        turn = np.clip(turn / TURN_TIME, -TURN_RATE, TURN_RATE)
        heading = heading + np.where(mode == AT_EASE, turn, 0.0) * STEP
        position = position + velocity * STEP
    paths = [
        GroundPath(time, places[:, n], headings[:, n], speeds[:, n], in_order(duels.actions[n]))
        for n in range(crowd.people)
    ]
    for keeper in range(min(2, players)):
        goal = np.array([-52.5, 0.0]) * side[keeper]
        paths[keeper] = keep_ready(paths[keeper], goal, ball)
    way = np.gradient(ball, STEP, axis=0)
    course = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    return paths, GroundPath(time, ball, course, np.linalg.norm(way, axis=-1))


def _targets(
    time: Floats,
    ball: Floats,
    players: int,
    people: int,
    side: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Return targets (samples, people, 2) [m], and by person a factor on the usual speed there."""
    samples = len(time)
    # One knot per second, without the jitter of a random walk in between.
    knots = np.arange(time[0], time[-1] + 2.0)
    roam = ROAM * drift((len(knots), people, 2), ROAM_TIME, 1.0, rng)
    roam = interp1d(knots, roam, axis=0)(time)
    start = rng.random((samples, people)) < STEP / SPRINT_EVERY
    aims = rng.uniform([12.0, -10.0], [26.0, 10.0], (people, 2))
    sprinting = np.zeros((samples, people), dtype=bool)
    for sample, person in np.argwhere(start):
        sprinting[sample : sample + round(SPRINT_TIME / STEP), person] = True
    hurry = np.where(sprinting, 3.0, 1.0)
    targets = np.empty((samples, people, 2))
    for person in range(people):
        role = person // 2
        if person < players:
            home = FORMATION[role % len(FORMATION)]
            follow, roaming = (KEEPER_FOLLOW, 0.3) if role == 0 else (FOLLOW, 1.0)
            targets[:, person] = side[person] * home + follow * ball + roaming * roam[:, person]
            if role > 0:
                run = side[person] * aims[person]
                targets[:, person] += np.where(sprinting[:, person, None], run, 0.0)
        elif person == players:
            targets[:, person] = 0.9 * ball + [-4.0, 7.0] + 0.4 * roam[:, person]
        else:
            # An assistant keeps level with the last defender of the assistant's half.
            half = 1.0 if (person - players) % 2 else -1.0
            line = half * np.clip(25.0 + half * FOLLOW[0] * ball[:, 0], 0.0, 50.0)
            targets[:, person] = np.stack([line, np.full(samples, half * 35.2)], axis=-1)
    low, high = np.array([-51.0, -35.5]), np.array([51.0, 35.5])
    return np.clip(targets, low, high), hurry


@dataclass(frozen=True, eq=False)
class _Wishes:
    """Desired motion of every person (people,).

    Attributes:
        hurry: factor on the usual speed to the target [1].
        haste: speed that reaches the target in time [m/s]; NaN = free choice.
        most: speed limit [m/s].
        mode: at ease, coasting, stopping or pushing off.
        off_leg: (people, 2), acceleration of those who push off [m/s^2].
    """

    hurry: Floats
    haste: Floats
    most: Floats
    mode: NDArray[np.int8]
    off_leg: Floats


def _steer(
    position: Floats,
    velocity: Floats,
    push: Floats,
    moving: NDArray[np.bool_],
    way: Floats,
    wishes: _Wishes,
    top: Floats,
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return velocity, acceleration and a mask of people on the move, one step later."""
    far = np.linalg.norm(way, axis=-1)
    called = ~np.isnan(wishes.haste)
    moving = (far > np.where(moving, NEAR_ENOUGH, WORTH_GOING)) | called
    wish = np.where(called, wishes.haste, EAGERNESS * wishes.hurry * far)
    wish = np.where(moving, np.minimum(wish, wishes.most), 0.0)
    wished = way * (wish / np.maximum(far, 1e-9))[:, None]
    apart = position[:, None] - position
    gap = np.linalg.norm(apart, axis=-1)
    near = np.clip(1.0 - gap / BODY_SPACE, 0.0, 1.0)
    wished = wished + 5.0 * (apart * (near / np.maximum(gap, 1e-9))[..., None]).sum(axis=1)
    wished = np.where((wishes.mode == STOPPING)[:, None], 0.0, wished)
    change = (wished - velocity) / REACTION
    # The limit of driving forces falls with speed, the limit of braking and turning does not.
    speed = np.linalg.norm(velocity, axis=-1)
    ahead = velocity / np.maximum(speed, 1e-9)[:, None]
    drive = (change * ahead).sum(-1)
    most = ACCELERATION * np.maximum(1.0 - speed / top, 0.0)
    change = change + (np.minimum(drive, most) - drive)[:, None] * ahead
    size = np.linalg.norm(change, axis=-1)
    change = change * np.minimum(1.0, ACCELERATION / np.maximum(size, 1e-9))[:, None]
    change = np.where((wishes.mode == COASTING)[:, None], 0.0, change)
    push = push + (change - push) * STEP / JERK_TIME
    push = np.where((wishes.mode == PUSHING)[:, None], wishes.off_leg, push)
    # A leg that pushed a person off the ground pushes no more.
    thrown = (wishes.mode == COASTING) & (np.linalg.norm(push, axis=-1) > ACCELERATION)
    push = np.where(thrown[:, None], 0.0, push)
    return velocity + push * STEP, push, moving
