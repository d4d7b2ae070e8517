"""Paths of people: smooth curves over a part of the pitch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.simulation.bvh import Clip
from worldpose.simulation.motions import Action
from worldpose.simulation.outbursts import draw_actions, steadied
from worldpose.simulation.settings import CrowdSettings

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
    low, high = crowd.speed
    speed = low + (high - low) * (0.5 + 0.5 * _slow_wave(time, (4.0, 9.0), rng))
    speed = np.maximum(speed, 0.0)
    whim = 0.8 * _slow_wave(time, (3.0, 8.0), rng)
    center, half = np.array(crowd.area_center), 0.5 * np.array(crowd.area_size)
    place = np.array([other.position for other in others]).reshape(len(others), len(time), 2)
    motion = np.array([_velocity(other) for other in others]).reshape(place.shape)

    starts = center + half * rng.uniform(-1.0, 1.0, (50, 2))
    clear = np.linalg.norm(starts[:, None] - place[:, 0], axis=-1).min(axis=1, initial=np.inf)
    start = int(np.argmax(np.minimum(clear, START_SPACE)))  # the first with room, else the best
    position, heading = np.empty((len(time), 2)), np.empty(len(time))
    here, angle, turn = starts[start], rng.uniform(-np.pi, np.pi), 0.0
    actions = draw_actions(time, speed, crowd.actions, rng)
    speed, steady = steadied(time, speed, actions)
    for i in range(len(time)):
        position[i], heading[i] = here, angle
        own = speed[i] * np.array([np.cos(angle), np.sin(angle)])
        velocity = own if steady[i] else own + _shove(here - place[:, i])
        speed[i] = np.linalg.norm(velocity)
        wish = (
            whim[i]
            + _turn_back(here + LOOK_AHEAD * velocity - center, half, angle)
            + _turn_aside(place[:, i] - here, motion[:, i] - velocity, angle, crowd.personal_space)
        )
        limit = min(TURN_RATE, LATERAL_ACCELERATION / max(speed[i], 0.1))
        limit *= min(1.0, speed[i] / TURNING_SPEED)
        turn += (float(np.clip(wish, -limit, limit)) - turn) * STEP / TURN_LAG
        # People in the air or on the ground do not turn.
        turn *= 0.92 if steady[i] else 1.0
        here = here + velocity * STEP
        angle = angle + turn * STEP
    return GroundPath(time, position, heading, speed, actions)


def _shove(apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity (2,) [m/s] of a person in contact with bodies (others, 2) [m] away."""
    gap = np.linalg.norm(apart, axis=-1, keepdims=True)
    push = SHOVE * np.clip(1.0 - gap / BODY_WIDTH, 0.0, 1.0)
    velocity: NDArray[np.float64] = (push * apart / np.maximum(gap, 1e-9)).sum(axis=0)
    return velocity


def _slow_wave(
    time: NDArray[np.float64], periods: tuple[float, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the sum of two sines of different period [s], within -1 and 1."""
    first = rng.uniform(*periods)
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
