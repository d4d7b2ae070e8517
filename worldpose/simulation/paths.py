"""Paths of people: smooth curves over a part of the pitch, with the actions of standing people.

Also the random processes in time that vary them and the errors of detections: drift and bursts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.simulation.falls import draw_actions, steady_speed
from worldpose.simulation.motions import (
    STANDING,
    Action,
    Arm,
    Height,
    Motion,
    Stance,
    key,
    stack_keys,
)
from worldpose.simulation.settings import ActionRates, CrowdSettings


def shift_weight(duration: float) -> Motion:
    """Return a shift of weight to the left leg, then to the right one."""

    def over(side: float) -> Floats:
        return key(
            turn=(0.0, 3.5 * side, 4.0 * side),
            bend=(4.0, -4.5 * side, -3.0 * side),
            away=(0.0, 0.045 * side),
        )

    return _hold_poses(
        "shift", duration, [key(), over(1.0), over(1.0), over(-1.0), over(-1.0), key()]
    )


def hands_on_hips(duration: float) -> Motion:
    """Return a rest with both hands on the hips, looking around."""
    arms = (Arm(-22.0, 46.0, 98.0, 76.0), Arm(-20.0, 44.0, 98.0, 76.0))

    def look(yaw: float, aside: float) -> Floats:
        return key(bend=(2.0, 0.0, 0.15 * yaw), nod=(0.0, 0.0, yaw), away=(0.0, aside), arms=arms)

    looks = [look(20.0, 0.02), look(45.0, 0.03), look(-35.0, -0.02)]
    return _hold_poses("hands on hips", duration, [key(), *looks, look(0.0, 0.0), key()])


def look_around(duration: float) -> Motion:
    """Return turns of the head, followed by the chest, from side to side."""

    def look(yaw: float) -> Floats:
        return key(bend=(3.0, 0.0, 0.25 * yaw), nod=(2.0, 0.0, yaw))

    return _hold_poses("look", duration, [key(), look(60.0), look(40.0), look(-65.0), key()])


def ready(duration: float) -> Motion:
    """Return a goalkeeper's ready stance: knees bent by 62 degrees, trunk leaning, hands up."""
    waiting = [
        key(
            turn=(27.0, 0.0, 0.0),
            bend=(5.0, 0.0, 0.0),
            nod=(-3.0, 0.0, 0.0),
            away=(0.0, aside),
            arms=(Arm(42.0, 28.0, 60.0, 20.0), Arm(42.0, 28.0, 60.0, 20.0)),
        )
        for aside in (0.02, -0.02, 0.02, -0.02)
    ]
    motion = _hold_poses("ready", duration, [key(), *waiting, key()])
    back = duration - 0.35
    return Motion(
        name=motion.name,
        duration=duration,
        time=motion.time,
        channels=motion.channels,
        # Thigh and shank of equal length that bend by 62 degrees leave 86 % of the leg.
        heights=(Height(0.0, 0.835),),
        stances=(
            (Stance(0.05, 0.35, back, 0.0, outward=0.08),),
            (Stance(0.2, 0.5, back - 0.1, 0.0, outward=0.08),),
        ),
        ease=(0.6, 0.5),
    )


def _hold_poses(name: str, duration: float, keys: Sequence[Floats]) -> Motion:
    time, channels = stack_keys(list(zip(np.linspace(0.0, duration, len(keys)), keys, strict=True)))
    return Motion(
        name, duration, time, channels, heights=(Height(0.0, STANDING - 0.005),), ease=(0.7, 0.7)
    )


STEP: Final = 0.01
"""Time between samples of a path [s]: 4 cm at 4 m/s, a hundredth of a stride."""
MARGIN: Final = 2.0
"""Path before the first and after the last frame [s]: more than one stride of the slowest walk."""
LATERAL_ACCELERATION: Final = 4.0
"""Maximum lateral acceleration of a runner [m/s^2]: a turn of 4 m radius at 4 m/s."""
TURN_RATE: Final = 2.0
"""Maximum turn rate of a walker [rad/s]."""
TURN_LAG: Final = 0.25
"""Time constant of a change of turn rate [s]: about one step."""
TURNING_SPEED: Final = 0.5
"""Slower people turn less; standing people do not turn [m/s]."""
LOOK_AHEAD: Final = 1.2
"""Time ahead at which people see borders and other people [s]."""
BODY_WIDTH: Final = 0.7
"""Distance between the middles of two people who touch shoulder to shoulder [m]."""
SHOVE: Final = 9.0
"""Speed that pushes a person out of another's middle [m/s]; smaller overlap pushes less."""
START_SPACE: Final = 2.5
"""Minimum distance between people at the start of their paths [m], where there is room."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A person's captured motion.

    Attributes:
        time: (frames,) [s], from 0.
        points: (frames, 13, 3) [m], z up, above the ground, in the order of
            `worldpose.simulation.recordings.NAMES`.
    """

    time: Floats
    points: Floats


@dataclass(frozen=True)
class GroundPath:
    """A person's path over the ground, sampled every `STEP`."""

    time: NDArray[np.float64]
    """(samples,) [s], from -MARGIN on; 0 is the first frame."""
    position: NDArray[np.float64]
    """(samples, 2) [m], world x and y of the pelvis."""
    heading: NDArray[np.float64]
    """(samples,) [rad] from the x axis towards y, without jumps."""
    speed: NDArray[np.float64]
    """(samples,) [m/s]."""
    actions: tuple[Action, ...] = ()
    """Actions of the person, in order of their start."""
    clip: Clip | None = None
    """Motion capture that the person plays from time 0 on, instead of a gait."""


def wander(
    crowd: CrowdSettings, duration: float, others: Sequence[GroundPath], rng: np.random.Generator
) -> GroundPath:
    """Return a smooth path with changing speed and turns that stays near the area.

    Args:
        crowd: area and speeds.
        duration: time covered besides the margins [s].
        others: paths to keep clear of; they do not react, so that an additional person changes no
            earlier path.
        rng: this person's own.
    """
    samples = round((duration + 2.0 * MARGIN) / STEP) + 1
    time = np.linspace(-MARGIN, -MARGIN + (samples - 1) * STEP, samples)
    low, high = crowd.speed_m_s
    speed = low + (high - low) * (0.5 + 0.5 * _slow_wave(time, (4.0, 9.0), rng))
    speed = np.maximum(speed, 0.0)
    whim = 0.8 * _slow_wave(time, (3.0, 8.0), rng)
    center, half = np.array(crowd.area_center_m), 0.5 * np.array(crowd.area_size_m)
    place = np.array([other.position for other in others]).reshape(len(others), len(time), 2)
    motion = np.array([_velocity(other) for other in others]).reshape(place.shape)

    starts = center + half * rng.uniform(-1.0, 1.0, (50, 2))
    clear = np.linalg.norm(starts[:, None] - place[:, 0], axis=-1).min(axis=1, initial=np.inf)
    start = int(np.argmax(np.minimum(clear, START_SPACE)))  # the first with room, else the best
    position, heading = np.empty((len(time), 2)), np.empty(len(time))
    here, angle, turn = starts[start], rng.uniform(-np.pi, np.pi), 0.0
    actions = draw_actions(time, speed, crowd.actions, rng)
    speed, steady = steady_speed(time, speed, actions)
    for i in range(len(time)):
        position[i], heading[i] = here, angle
        own = speed[i] * np.array([np.cos(angle), np.sin(angle)])
        velocity = own if steady[i] else own + _shove_velocity(here - place[:, i])
        speed[i] = np.linalg.norm(velocity)
        wish = (
            whim[i]
            + _turn_back(here + LOOK_AHEAD * velocity - center, half, angle)
            + _turn_aside(
                place[:, i] - here, motion[:, i] - velocity, angle, crowd.personal_space_m
            )
        )
        limit = min(TURN_RATE, LATERAL_ACCELERATION / max(speed[i], 0.1))
        limit *= min(1.0, speed[i] / TURNING_SPEED)
        turn += (float(np.clip(wish, -limit, limit)) - turn) * STEP / TURN_LAG
        # People in the air or on the ground do not turn.
        turn *= 0.92 if steady[i] else 1.0
        here = here + velocity * STEP
        angle = angle + turn * STEP
    return GroundPath(time, position, heading, speed, actions)


def _shove_velocity(apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity (2,) [m/s] of a person in contact with bodies (others, 2) [m] away."""
    gap = np.linalg.norm(apart, axis=-1, keepdims=True)
    push = SHOVE * np.clip(1.0 - gap / BODY_WIDTH, 0.0, 1.0)
    velocity: NDArray[np.float64] = (push * apart / np.maximum(gap, 1e-9)).sum(axis=0)
    return velocity


def _slow_wave(
    time: NDArray[np.float64], periods: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the sum of two sines of different period [s], within -1 and 1."""
    first = rng.uniform(periods[0], periods[1])
    angle = 2.0 * np.pi * (time[:, None] / (first, 0.6 * first) + rng.random(2))
    wave: NDArray[np.float64] = np.sin(angle) @ np.array([0.65, 0.35])
    return wave


def _velocity(path: GroundPath) -> NDArray[np.float64]:
    direction = np.stack([np.cos(path.heading), np.sin(path.heading)], axis=-1)
    velocity: NDArray[np.float64] = path.speed[:, None] * direction
    return velocity


def _turn_back(ahead: NDArray[np.float64], half: NDArray[np.float64], heading: float) -> float:
    """Return the turn rate [rad/s] towards the middle if the place ahead of it is outside."""
    outside = float(np.max(np.abs(ahead) / half)) - 1.0
    if outside <= 0.0:
        return 0.0
    homeward = float(np.arctan2(-ahead[1], -ahead[0])) - heading
    shorter = (homeward + np.pi) % (2.0 * np.pi) - np.pi
    return 2.0 * TURN_RATE * min(1.0, 3.0 * outside) * float(np.sin(0.5 * shorter))


def _turn_aside(
    offsets: NDArray[np.float64], motions: NDArray[np.float64], heading: float, space: float
) -> float:
    """Return the turn rate [rad/s] away from people on a close course, from relative motions."""
    if not len(offsets) or space == 0.0:
        return 0.0
    approach = -(offsets * motions).sum(-1) / np.maximum((motions**2).sum(-1), 1e-9)
    nearest = offsets + motions * np.clip(approach, 0.0, LOOK_AHEAD)[:, None]
    urgency = np.clip(1.0 - np.linalg.norm(nearest, axis=-1) / space, 0.0, 1.0)
    leftward = np.array([-np.sin(heading), np.cos(heading)])
    # On an exact collision course, pass on one side rather than meet undecided.
    away = np.where(nearest @ leftward > 0.0, -1.0, 1.0)
    return float(2.0 * TURN_RATE * (urgency * away).sum())


STANDING_SPEED: Final = 0.25
"""Slower people stand [m/s]."""
MIN_REST: Final = 1.6
"""Minimum duration of a rest with actions [s]."""
MAX_ACTION_TIMES: Final = (3.0, 6.0)
"""Range of the maximum duration of an action [s]."""
ALERT: Final = 35.0
"""Distance of the ball from the goal at which a goalkeeper gets ready [m]."""


def stand_about(path: GroundPath, rates: ActionRates, rng: np.random.Generator) -> GroundPath:
    """Return the path with actions while the person stands: shift weight, look, hands on hips."""
    motions = (shift_weight, look_around, hands_on_hips)
    actions = list(path.actions)
    for begin, end in _rest_intervals(path):
        while end - begin > MIN_REST:
            duration = min(end - begin, rng.uniform(MAX_ACTION_TIMES[0], MAX_ACTION_TIMES[1]))
            kind, left = rng.choice(len(motions), p=(0.5, 0.3, 0.2)), bool(rng.random() < 0.5)
            if rng.random() < rates.standing_about:
                actions.append(Action(begin, motions[kind](duration), left))
            begin += duration
    return replace(path, actions=_sort_actions(actions))


def keep_ready(path: GroundPath, goal: Floats, ball: Floats) -> GroundPath:
    """Return a goalkeeper's path, with readiness during rests while the ball is near.

    Args:
        path: path of the goalkeeper.
        goal: (2,) [m].
        ball: (samples, 2) [m], at the path's times.
    """
    near = np.linalg.norm(ball - goal, axis=-1) < ALERT
    actions = list(path.actions)
    for begin, end in _rest_intervals(path, near):
        if end - begin > MIN_REST:
            actions.append(Action(begin, ready(end - begin)))
    return replace(path, actions=_sort_actions(actions))


def _rest_intervals(
    path: GroundPath, also: NDArray[np.bool_] | None = None
) -> list[tuple[float, float]]:
    """Return start and end [s] of intervals in which a person stands without other actions."""
    still = path.speed < STANDING_SPEED
    turning = np.abs(np.gradient(path.heading, path.time))
    still &= turning < 0.5 * STANDING_SPEED
    if also is not None:
        still &= also
    for action in path.actions:
        still &= (path.time < action.begin) | (path.time > action.end)
    edges = np.diff(np.concatenate([[0], still.astype(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return [(float(path.time[a]), float(path.time[b])) for a, b in zip(begins, ends, strict=True)]


def _sort_actions(actions: list[Action]) -> tuple[Action, ...]:
    return tuple(sorted(actions, key=lambda action: action.begin))


def drift(
    shape: tuple[int, ...], time: float, fps: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return a stationary first-order autoregressive process of unit variance along the first axis.

    Args:
        shape: (frames, ...).
        time: time constant [s].
        fps: [1/s].
        rng: draws `shape` normal numbers.
    """
    keep = float(np.exp(-1.0 / (time * fps)))
    process = rng.standard_normal(shape)
    process[1:] *= np.sqrt(1.0 - keep**2)
    # Not scipy's lfilter: all of scipy.signal takes a second to import.
    for frame in range(1, len(process)):
        process[frame] += keep * process[frame - 1]
    return process


def bursts(
    share: float, time: float, shape: tuple[int, ...], fps: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return a stationary on-off process along the first axis: on for a given share of the frames.

    Args:
        share: share of frames that are on, below 1.
        time: mean length of an interval that is on [s]; at least one frame.
        shape: (frames, ...).
        fps: [1/s].
        rng: draws `shape` uniform numbers.
    """
    draws = rng.random(shape)
    # A draw below `start` switches on, one above 1 - stop switches off, others change nothing.
    rate = min(1.0, 1.0 / (time * fps * (1.0 - share)))
    start, stop = share * rate, (1.0 - share) * rate
    event = (draws < start).astype(np.int8) - (draws >= 1.0 - stop)
    event[:1] = np.where(draws[:1] < share, 1, -1)
    frame = np.arange(shape[0]).reshape(-1, *(1 for _ in shape[1:]))
    latest = np.maximum.accumulate(np.where(event != 0, frame, 0), axis=0)
    on: NDArray[np.bool_] = np.take_along_axis(event, latest, axis=0) > 0
    return on
