"""Motions of upright footballers: jumps and kicks."""

from __future__ import annotations

from typing import Final

import numpy as np

from worldpose.simulation.motions import GRAVITY, Arm, Height, Leg, Motion, Stance, key, motion_of

STANDING: Final = 0.945
"""Mid-hip height of a standing person, in leg lengths [1]."""
REST: Final = key()
"""Standing upright."""


def jump(rise: float, *, hurdle: bool = False) -> Motion:
    """Return a header off both feet: crouch, take-off, flight, landing; the left foot leaves last.

    Args:
        rise: of the mid-hip in flight [m]; footballers reach 0.35 to 0.45 with a countermovement
            (docs/explanation/synthetic.md).
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
    time, channels = motion_of(
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

    def swing(
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
    time, channels = motion_of(
        [
            (0.0, REST),
            (0.2, down),
            (0.38, swing(-12.0 - 18.0 * p, 45.0 + 35.0 * p, 14.0, 24.0, -8.0, -8.0, 0.0)),
            (0.46, swing(-8.0 * p, 60.0 + 42.0 * p, 16.0, 14.0, -12.0, -4.0, 0.2)),
            (0.51, swing(6.0 + 11.0 * p, 50.0 + 34.0 * p, 12.0, 3.0, -14.0, 0.0, 0.45)),
            (hit, swing(14.0 + 15.0 * p, 32.0 + 4.0 * p, 7.0, -6.0, -14.0, 4.0, 0.7)),
            (0.63, swing(22.0 + 20.0 * p, 14.0 - 4.0 * p, -2.0, -14.0, -12.0, 8.0, 1.0)),
            (0.76, swing(28.0 + 40.0 * p, 12.0 + 6.0 * p, -8.0, -18.0, -8.0, 10.0, 1.0)),
            (0.95, swing(26.0 + 14.0 * p, 30.0 + 15.0 * p, -2.0, -8.0, -3.0, 8.0, 0.8)),
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
