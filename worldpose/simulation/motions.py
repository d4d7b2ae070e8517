"""Motions of a body other than gait, as key poses in time.

Angles are those of sports biomechanics: hips and shoulders flex forward and abduct outward, knees
and elbows flex; zero is standing upright with arms hanging.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from data_contracts.arrays import Floats

GRAVITY: Final = 9.81
"""[m/s^2]"""


class Arm(NamedTuple):
    """Angles of an arm [degree]."""

    flexion: float = 5.0
    abduction: float = 9.0
    elbow: float = 22.0
    inward: float = 0.0
    """Angle by which the elbow bends inward instead of forward."""


class Leg(NamedTuple):
    """Angles of a leg [degree]."""

    flexion: float = 12.0
    abduction: float = 0.0
    knee: float = 24.0
    inward: float = 0.0
    """Angle by which the knee's hinge turns the shank inward instead of backward."""


class Height(NamedTuple):
    """Height of the mid-hip above a standing ankle at some time."""

    time: float
    """[s] from the beginning."""
    legs: float
    """In leg lengths [1] ..."""
    metres: float = 0.0
    """... and metres [m]."""
    climb: float | None = None
    """[m/s]; None = as smooth as can be. Between two heights it is a cubic of time: with the
    climbs of free flight at both ends it is free flight."""


class Stance(NamedTuple):
    """Standing phase of a foot at one place."""

    lift: float
    """Departure for that place [s] from the beginning."""
    land: float
    """Arrival [s]."""
    leave: float
    """Departure from it [s]."""
    under: float
    """Time that defines the person's position as the foot's place [s]."""
    ahead: float = 0.0
    """Offset of the foot ahead of it [m]."""
    outward: float = 0.0
    """Offset of the foot outward [m]."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of a body whose acting side is the left one.

    Attributes:
        name: of the motion.
        duration: [s].
        time: (keys,) of key poses [s].
        channels: (keys, channels), as `key` lays them out.
        heights: of the mid-hip.
        stances: of the acting foot and of the other one; before and after both walk.
        ease: time of blending in and out [s].
        flight: when the body is in the air [s]; None = never.
        blow: time of the decisive contact: the kick, the head at the ball, the tackle [s].
        stops: when the person begins to come to rest [s]; None = does not stop.
        moves_again: when the person is up again [s].
    """

    name: str
    duration: float
    time: Floats
    channels: Floats
    heights: tuple[Height, ...]
    stances: tuple[tuple[Stance, ...], tuple[Stance, ...]] = ((), ())
    ease: tuple[float, float] = (0.2, 0.3)
    flight: tuple[float, float] | None = None
    blow: float = 0.0
    stops: float | None = None
    moves_again: float = 0.0


@dataclass(frozen=True, eq=False)
class Action:
    """A person's action at some time, in addition to moving somewhere.

    Attributes:
        begin: [s].
        motion: of the body.
        left: whether the left side acts.
        turn: direction of its aim, relative to the heading, to the left [rad].
    """

    begin: float
    motion: Motion
    left: bool = True
    turn: float = 0.0

    @property
    def end(self) -> float:
        """Return the end time [s]."""
        return self.begin + self.motion.duration


TURN: Final = slice(0, 3)
"""Channels: pitch forward, roll to the left, yaw to the left of the pelvis [rad]."""
BEND: Final = slice(3, 6)
"""The same angles of the chest, relative to the pelvis [rad]."""
NOD: Final = slice(6, 9)
"""The same angles of the head, relative to the heading [rad]."""
AWAY: Final = slice(9, 11)
"""Displacement of the mid-hip, forward and to the left [m]."""
FREE: Final = slice(11, 13)
"""Freedom of the feet: 0 = the foot stands or walks, 1 = the leg's pose determines it."""
ARMS: Final = slice(13, 25)
"""(2, 2, 3): side; upper arm, forearm; forward, outward, up in the chest's axes."""
LEGS: Final = slice(25, 43)
"""(2, 3, 3): side; thigh, shank, knee; forward, outward, up in the pelvis' axes."""


def key(
    *,
    turn: Sequence[float] = (0.0, 0.0, 0.0),
    bend: Sequence[float] = (3.0, 0.0, 0.0),
    nod: Sequence[float] = (0.0, 0.0, 0.0),
    away: Sequence[float] = (0.0, 0.0),
    free: Sequence[float] = (0.0, 0.0),
    arms: Sequence[Arm] = (Arm(), Arm()),
    legs: Sequence[Leg] = (Leg(), Leg()),
) -> Floats:
    """Return channels (43,) of a key pose; angles in degrees, the acting side first."""
    angles = np.radians([*turn, *bend, *nod])
    return np.concatenate(
        [
            angles,
            [*away, *free],
            *(_arm_vectors(arm) for arm in arms),
            *(_leg_vectors(leg) for leg in legs),
        ]
    )


def motion_of(keys: Sequence[tuple[float, Floats]]) -> tuple[Floats, Floats]:
    """Return times (keys,) and channels (keys, 43) of key poses in order."""
    return np.array([time for time, _ in keys]), np.array([channels for _, channels in keys])


def _limb(flexion: float, abduction: float, inward: float) -> tuple[Floats, Floats]:
    """Return a limb's direction, and its end's direction under further flexion or inward turn."""
    (sin, out, turned), (cos, level, straight) = (
        f(np.radians([flexion, abduction, inward])) for f in (np.sin, np.cos)
    )
    along = np.array([sin * level, out, -cos * level])
    forward = np.array([cos, 0.0, sin])
    inwards = np.array([sin * out, -level, -cos * out])
    return along, straight * forward + turned * inwards


def _arm_vectors(arm: Arm) -> Floats:
    upper, forward = _limb(arm.flexion, arm.abduction, arm.inward)
    bend = np.radians(arm.elbow)
    return np.concatenate([upper, np.cos(bend) * upper + np.sin(bend) * forward])


def _leg_vectors(leg: Leg) -> Floats:
    thigh, forward = _limb(leg.flexion, leg.abduction, leg.inward)
    bend = np.radians(leg.knee)
    shank = np.cos(bend) * thigh - np.sin(bend) * forward
    # Halfway between the two bones' normals: square to a line from hip to ankle of equal bones.
    knee = np.sin(0.5 * bend) * thigh + np.cos(0.5 * bend) * forward
    return np.concatenate([thigh, shank, knee])
