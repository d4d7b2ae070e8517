"""Motions of a body other than gait, as key poses in time: jumps and kicks.

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
SETTLE: Final = 0.35
"""Time before take-off in which people keep their pace [s]."""


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
        name: name of the motion.
        duration: [s].
        time: (keys,) time of key poses [s].
        channels: (keys, channels), as `key` lays them out.
        heights: heights of the mid-hip.
        stances: stances of the acting foot and of the other one; before and after both walk.
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
        motion: motion of the body.
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


def stack_keys(keys: Sequence[tuple[float, Floats]]) -> tuple[Floats, Floats]:
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


STANDING: Final = 0.945
"""Mid-hip height of a standing person, in leg lengths [1]."""
REST: Final = key()
"""Standing upright."""


def jump(rise: float, *, hurdle: bool = False) -> Motion:
    """Return a header off both feet: crouch, take-off, flight, landing; the left foot leaves last.

    Args:
        rise: rise of the mid-hip in flight [m]; footballers reach 0.35 to 0.45 with a
            countermovement (docs/explanation/simulation.md).
        hurdle: knees come up and the head stays down, as over a sliding player.
    """
    climb = float(np.sqrt(2.0 * GRAVITY * rise))
    off = 0.62
    top = off + climb / GRAVITY
    land = off + 2.0 * climb / GRAVITY
    crouch = key(
        turn=(28.0, 0.0, 0.0),
        bend=(12.0, 0.0, 0.0),
        nod=(-5.0, 0.0, 0.0),
        arms=(Arm(-40.0, 18.0, 25.0), Arm(-42.0, 18.0, 25.0)),
    )
    stretched = key(
        turn=(4.0, 0.0, 0.0),
        bend=(-2.0, 0.0, 0.0),
        nod=(-12.0, 0.0, 0.0),
        arms=(Arm(80.0, 35.0, 60.0), Arm(70.0, 35.0, 65.0)),
        legs=(Leg(-4.0, 2.0, 8.0), Leg(-4.0, 2.0, 8.0)),
    )
    legs = (Leg(8.0, 4.0, 40.0), Leg(2.0, 4.0, 55.0))
    if hurdle:
        legs = (Leg(75.0, 8.0, 80.0), Leg(50.0, 8.0, 85.0))
    arched = key(
        turn=(0.0 if not hurdle else 12.0, 0.0, 0.0),
        bend=(-14.0 if not hurdle else 10.0, 0.0, 0.0),
        nod=(-20.0 if not hurdle else 15.0, 0.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(50.0, 60.0, 70.0), Arm(40.0, 60.0, 75.0)),
        legs=legs,
    )
    nodded = key(
        turn=(10.0, 0.0, 0.0),
        bend=(18.0, 0.0, 0.0),
        nod=(22.0, 0.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(0.0, 50.0, 60.0), Arm(-5.0, 50.0, 60.0)),
        legs=(Leg(20.0, 4.0, 32.0), Leg(16.0, 4.0, 36.0)),
    )
    absorbed = key(
        turn=(24.0, 0.0, 0.0),
        bend=(12.0, 0.0, 0.0),
        arms=(Arm(10.0, 40.0, 40.0), Arm(10.0, 40.0, 40.0)),
    )
    time, channels = stack_keys(
        [
            (0.0, REST),
            (0.36, crouch),
            (off, stretched),
            (top - 0.02 if hurdle else 0.5 * (off + top), arched),
            (land - 0.12 if hurdle else top + 0.08, nodded),
            (land - 0.05, nodded),
            (land + 0.02, absorbed * 0.35 + stretched * 0.65),
            (land + 0.2, absorbed),
            (land + 0.75, REST),
        ]
    )
    stances = tuple(
        (
            Stance(lift, lift + 0.2, off, 0.42, outward=0.02),
            Stance(off, land, land + leave, land + 0.15, outward=0.04),
        )
        for lift, leave in ((0.12, 0.3), (0.0, 0.42))
    )
    return Motion(
        name="hurdle" if hurdle else "jump",
        duration=land + 0.8,
        time=time,
        channels=channels,
        heights=(
            Height(0.0, STANDING),
            Height(0.36, 0.74),
            Height(off, 1.0, 0.03, climb),
            Height(land, 1.0, 0.03, -climb),
            Height(land + 0.2, 0.76),
            Height(land + 0.75, STANDING),
        ),
        stances=(stances[0], stances[1]),
        ease=(0.2, 0.35),
        flight=(off, land),
        blow=top,
    )


def kick(power: float) -> Motion:
    """Return a kick with the left foot: plant, back swing, hip before knee, follow-through.

    Args:
        power: 0.4 is a pass, 1 a shot with the instep [1].
    """
    p = power
    hit = 0.56

    def swing_key(
        hip: float, knee: float, out: float, yaw: float, roll: float, pitch: float, arms: float
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """Return a key; arms go from 0, spread back, to 1, across."""
        return key(
            turn=(p * pitch, p * roll, p * yaw),
            bend=(4.0, -0.3 * p * roll, -1.2 * p * yaw),
            nod=(18.0, 0.0, 0.0),
            free=(1.0, 0.0),
            arms=(
                Arm(p * (25.0 - 65.0 * arms), 15.0 + 25.0 * p, 35.0),
                Arm(p * (-30.0 + 85.0 * arms), 15.0 + p * (50.0 - 25.0 * arms), 30.0),
            ),
            legs=(Leg(hip, out, knee), Leg()),
        )

    down = key(nod=(15.0, 0.0, 0.0), arms=(Arm(10.0, 20.0, 35.0), Arm(-10.0, 30.0, 35.0)))
    time, channels = stack_keys(
        [
            (0.0, REST),
            (0.2, down),
            (0.38, swing_key(-12.0 - 18.0 * p, 45.0 + 35.0 * p, 14.0, 24.0, -8.0, -8.0, 0.0)),
            (0.46, swing_key(-8.0 * p, 60.0 + 42.0 * p, 16.0, 14.0, -12.0, -4.0, 0.2)),
            (0.51, swing_key(6.0 + 11.0 * p, 50.0 + 34.0 * p, 12.0, 3.0, -14.0, 0.0, 0.45)),
            (hit, swing_key(14.0 + 15.0 * p, 32.0 + 4.0 * p, 7.0, -6.0, -14.0, 4.0, 0.7)),
            (0.63, swing_key(22.0 + 20.0 * p, 14.0 - 4.0 * p, -2.0, -14.0, -12.0, 8.0, 1.0)),
            (0.76, swing_key(28.0 + 40.0 * p, 12.0 + 6.0 * p, -8.0, -18.0, -8.0, 10.0, 1.0)),
            (0.95, swing_key(26.0 + 14.0 * p, 30.0 + 15.0 * p, -2.0, -8.0, -3.0, 8.0, 0.8)),
            (1.2, key(turn=(4.0, 0.0, 0.0), arms=(Arm(-5.0), Arm(12.0)))),
            (1.4, REST),
        ]
    )
    return Motion(
        name="kick",
        duration=1.4,
        time=time,
        channels=channels,
        heights=(
            Height(0.0, STANDING),
            Height(0.3, 0.93),
            Height(0.46, 0.90),
            Height(hit, 0.905),
            Height(0.8, 0.93),
            Height(1.3, STANDING),
        ),
        stances=((), (Stance(0.08, 0.34, 0.9, 0.52, ahead=0.06),)),
        ease=(0.2, 0.4),
        blow=hit,
    )
