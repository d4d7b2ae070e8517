"""Motions of footballers on the ground, and jumps and falls of wandering people."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.simulation.motions import (
    GRAVITY,
    REST,
    SETTLE,
    STANDING,
    Action,
    Arm,
    Height,
    Leg,
    Motion,
    Stance,
    jump,
    key,
    stack_keys,
)
from worldpose.simulation.settings import ActionRates


def fall() -> Motion:
    """Return a stumble and forward fall onto the hands, then lying, kneeling and getting up."""
    prone_arms = (Arm(168.0, 55.0, 75.0, 90.0), Arm(165.0, 60.0, 80.0, 90.0))
    reaching = (Arm(95.0, 20.0, 30.0), Arm(105.0, 15.0, 25.0))
    prone = key(
        turn=(86.0, 0.0, 0.0),
        bend=(-6.0, 0.0, 0.0),
        nod=(62.0, 0.0, 12.0),
        free=(1.0, 1.0),
        arms=prone_arms,
        legs=(Leg(2.0, 8.0, 12.0), Leg(4.0, 8.0, 22.0)),
    )
    on_all_fours = key(
        turn=(64.0, 0.0, 0.0),
        nod=(45.0, 0.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(66.0, 10.0, 12.0), Arm(70.0, 10.0, 12.0)),
        legs=(Leg(64.0, 4.0, 94.0), Leg(66.0, 4.0, 94.0)),
    )
    kneeling = key(
        turn=(34.0, 0.0, 0.0),
        bend=(10.0, 0.0, 0.0),
        nod=(15.0, 0.0, 0.0),
        free=(1.0, 0.0),
        arms=(Arm(30.0, 12.0, 25.0), Arm(45.0, 10.0, 40.0)),
        legs=(Leg(30.0, 2.0, 92.0), Leg()),
    )
    rising = key(
        turn=(40.0, 0.0, 0.0),
        bend=(10.0, 0.0, 0.0),
        nod=(5.0, 0.0, 0.0),
        arms=(Arm(15.0, 12.0, 30.0), Arm(35.0, 10.0, 30.0)),
        legs=(Leg(35.0, 2.0, 70.0), Leg()),
    )
    time, channels = stack_keys(
        [
            (0.0, REST),
            (
                0.25,
                key(
                    turn=(20.0, 0.0, 0.0),
                    nod=(5.0, 0.0, 0.0),
                    free=(0.3, 0.0),
                    arms=(Arm(45.0, 30.0, 40.0), Arm(60.0, 25.0, 40.0)),
                    legs=(Leg(-10.0, 4.0, 50.0), Leg(20.0, 2.0, 40.0)),
                ),
            ),
            (
                0.5,
                key(
                    turn=(52.0, 0.0, 0.0),
                    nod=(20.0, 0.0, 0.0),
                    free=(1.0, 0.7),
                    arms=reaching,
                    legs=(Leg(0.0, 6.0, 55.0), Leg(25.0, 4.0, 70.0)),
                ),
            ),
            (
                0.72,
                key(
                    turn=(76.0, 0.0, 0.0),
                    nod=(45.0, 0.0, 0.0),
                    free=(1.0, 1.0),
                    arms=(Arm(120.0, 35.0, 50.0, 30.0), Arm(125.0, 35.0, 50.0, 30.0)),
                    legs=(Leg(4.0, 8.0, 30.0), Leg(12.0, 6.0, 45.0)),
                ),
            ),
            (0.95, prone),
            (1.45, prone),
            (2.0, on_all_fours),
            (2.15, on_all_fours),
            (2.55, kneeling),
            (2.95, rising),
            (3.5, REST),
        ]
    )
    return Motion(
        name="fall",
        duration=3.6,
        time=time,
        channels=channels,
        heights=(
            Height(0.0, STANDING),
            Height(0.25, 0.88),
            Height(0.5, 0.62),
            Height(0.72, 0.3),
            Height(0.92, 0.06),
            Height(1.45, 0.06),
            Height(1.72, 0.37),
            Height(2.0, 0.47),
            Height(2.55, 0.5),
            Height(2.95, 0.72),
            Height(3.5, STANDING),
        ),
        stances=(
            (Stance(2.55, 2.85, 3.2, 2.9, ahead=-0.12, outward=0.02),),
            (
                Stance(0.0, 0.26, 0.42, 0.34, ahead=0.1),
                Stance(2.1, 2.45, 3.3, 2.9, ahead=0.2, outward=0.03),
            ),
        ),
        ease=(0.2, 0.4),
        blow=0.3,
        stops=0.45,
        moves_again=3.0,
    )


def slide() -> Motion:
    """Return a slide tackle with the left leg ahead, and getting up over both feet."""
    low = key(
        turn=(-42.0, -6.0, 8.0),
        bend=(14.0, 4.0, -6.0),
        nod=(6.0, 0.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(55.0, 55.0, 30.0), Arm(-42.0, 28.0, 12.0)),
        legs=(Leg(42.0, 4.0, 8.0), Leg(44.0, 22.0, 100.0, -75.0)),
    )
    sitting = key(
        turn=(-8.0, -4.0, 0.0),
        bend=(18.0, 0.0, 0.0),
        nod=(8.0, 0.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(45.0, 25.0, 40.0), Arm(-25.0, 30.0, 15.0)),
        legs=(Leg(95.0, 4.0, 70.0), Leg(85.0, 20.0, 105.0, -55.0)),
    )
    squatting = key(
        turn=(42.0, 0.0, 0.0),
        bend=(12.0, 0.0, 0.0),
        nod=(-5.0, 0.0, 0.0),
        arms=(Arm(60.0, 20.0, 20.0), Arm(50.0, 20.0, 20.0)),
        legs=(Leg(95.0, 8.0, 115.0), Leg(95.0, 8.0, 115.0)),
    )
    time, channels = stack_keys(
        [
            (0.0, REST),
            (
                0.2,
                key(
                    turn=(-8.0, 0.0, 4.0),
                    free=(0.5, 0.0),
                    arms=(Arm(35.0, 40.0, 30.0), Arm(-20.0, 40.0, 25.0)),
                    legs=(Leg(45.0, 2.0, 45.0), Leg(20.0, 2.0, 50.0)),
                ),
            ),
            (0.34, 0.55 * low + 0.45 * REST),
            (0.5, low),
            (1.35, low),
            (1.75, sitting),
            (2.2, squatting),
            (2.6, 0.5 * squatting + 0.5 * REST),
            (3.0, REST),
        ]
    )
    return Motion(
        name="slide",
        duration=3.1,
        time=time,
        channels=channels,
        heights=(
            Height(0.0, STANDING),
            Height(0.2, 0.8),
            Height(0.34, 0.42),
            Height(0.5, 0.1),
            Height(1.35, 0.07),
            Height(1.75, 0.12),
            Height(2.2, 0.42),
            Height(2.6, 0.78),
            Height(3.0, STANDING),
        ),
        stances=(
            (Stance(1.5, 1.85, 2.8, 2.2, ahead=0.22, outward=0.05),),
            (Stance(1.7, 2.1, 2.85, 2.2, ahead=-0.02, outward=0.05),),
        ),
        ease=(0.15, 0.4),
        blow=0.6,
        stops=0.3,
        moves_again=2.6,
    )


def dive(climb: float) -> Motion:
    """Return a goalkeeper's dive to the left off the right foot, side landing, and getting up.

    Args:
        climb: climb of the mid-hip at take-off [m/s]: 1 for a low ball, 2.5 for a high one.
    """
    off, high, low = 0.52, 0.80, 0.2
    # For a leg of 0.87 m; with others the same flight ends centimetres higher or lower.
    drop = (high - low) * 0.87
    flight = (climb + float(np.sqrt(climb**2 + 2.0 * GRAVITY * drop))) / GRAVITY
    land = off + flight
    crouch = key(
        turn=(30.0, 6.0, 0.0),
        bend=(6.0, 0.0, 0.0),
        nod=(0.0, 0.0, 10.0),
        arms=(Arm(45.0, 30.0, 60.0), Arm(45.0, 30.0, 60.0)),
    )
    pushed = key(
        turn=(18.0, 34.0, 0.0),
        bend=(2.0, 6.0, 0.0),
        nod=(0.0, 25.0, 10.0),
        free=(0.8, 0.0),
        arms=(Arm(110.0, 30.0, 25.0), Arm(95.0, 15.0, 45.0)),
        legs=(Leg(45.0, 10.0, 60.0), Leg(5.0, 22.0, 10.0)),
    )
    stretched = key(
        turn=(8.0, 62.0, 0.0),
        bend=(-4.0, 4.0, 0.0),
        nod=(5.0, 48.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(160.0, 22.0, 12.0), Arm(150.0, -4.0, 25.0)),
        legs=(Leg(32.0, 4.0, 50.0), Leg(4.0, 16.0, 22.0)),
    )
    lying = key(
        turn=(10.0, 74.0, 0.0),
        bend=(6.0, -14.0, 0.0),
        nod=(12.0, 50.0, 0.0),
        free=(1.0, 1.0),
        arms=(Arm(150.0, 18.0, 30.0), Arm(130.0, -6.0, 50.0)),
        legs=(Leg(45.0, 4.0, 60.0), Leg(30.0, 10.0, 45.0)),
    )
    kneeling = key(
        turn=(45.0, 12.0, 0.0),
        bend=(8.0, 0.0, 0.0),
        nod=(10.0, 0.0, 0.0),
        free=(1.0, 0.5),
        arms=(Arm(50.0, 15.0, 20.0), Arm(55.0, 15.0, 30.0)),
        legs=(Leg(50.0, 6.0, 95.0), Leg(80.0, 6.0, 100.0)),
    )
    time, channels = stack_keys(
        [
            (0.0, REST),
            (0.28, crouch),
            (off - 0.06, 0.25 * crouch + 0.75 * pushed),
            (off, pushed),
            (off + 0.5 * flight, stretched),
            (land, stretched),
            (land + 0.14, lying),
            (land + 0.6, lying),
            (land + 1.15, kneeling),
            (land + 1.6, key(turn=(35.0, 0.0, 0.0), arms=(Arm(30.0), Arm(30.0)))),
            (land + 2.1, REST),
        ]
    )
    return Motion(
        name="dive",
        duration=land + 2.2,
        time=time,
        channels=channels,
        heights=(
            Height(0.0, STANDING),
            Height(0.3, 0.74),
            Height(off, high, 0.0, climb),
            Height(
                land, high, climb * flight - 0.5 * GRAVITY * flight**2, climb - GRAVITY * flight
            ),
            Height(land + 0.09, 0.1, 0.0, 0.0),
            Height(land + 0.25, 0.08),
            Height(land + 0.6, 0.08),
            Height(land + 0.85, 0.36),
            Height(land + 1.15, 0.49),
            Height(land + 1.6, 0.72),
            Height(land + 2.1, STANDING),
        ),
        stances=(
            (
                Stance(0.0, 0.22, off - 0.12, 0.1, outward=0.14),
                Stance(land + 1.15, land + 1.45, land + 2.0, land + 1.6, ahead=-0.05, outward=0.05),
            ),
            (
                Stance(0.0, 0.16, off + 0.04, 0.0, outward=0.1),
                Stance(land + 0.8, land + 1.1, land + 2.1, land + 1.6, ahead=0.15, outward=0.05),
            ),
        ),
        ease=(0.2, 0.4),
        flight=(off, land),
        blow=off + 0.6 * flight,
        stops=land,
        moves_again=land + 1.7,
    )


MAX_JUMP_SPEED: Final = 2.5
"""Faster people do not jump off both feet [m/s]."""
BRAKE: Final = 4.0
"""Deceleration of a fallen person [m/s^2]."""
RECOVERY: Final = 1.5
"""Time in which the desired pace returns [s]."""


def draw_actions(
    time: Floats, speed: Floats, rates: ActionRates, rng: np.random.Generator
) -> tuple[Action, ...]:
    """Return jumps and falls of a wandering person, without overlap in time.

    Args:
        time: (samples,) [s].
        speed: (samples,) [m/s], which `steady_speed` changes to suit.
        rates: frequencies of actions.
        rng: draws them.
    """
    minutes = (time[-1] - time[0]) / 60.0
    count = rng.poisson(minutes * (rates.jumps_per_min + rates.falls_per_min))
    begins, draws = np.sort(rng.uniform(time[0], time[-1], count)), rng.random((count, 3))
    actions: list[Action] = []
    for begin, (kind, size, side) in zip(begins, draws, strict=True):
        jumps = kind * (rates.jumps_per_min + rates.falls_per_min) < rates.jumps_per_min
        motion: Motion = jump(0.28 + 0.17 * size) if jumps else fall()
        pace = float(np.interp(begin, time, speed))
        suits = pace < MAX_JUMP_SPEED if jumps else 1.0 < pace < 5.0
        if suits and (not actions or begin > actions[-1].end):
            actions.append(Action(float(begin), motion, bool(side < 0.5)))
    return tuple(actions)


def steady_speed(
    time: Floats, speed: Floats, actions: tuple[Action, ...]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return speeds (samples,) [m/s] that suit the actions, and when turns are blocked.

    Speed is constant in flight and just before; a fallen person rests until up again.
    """
    speed, steady = speed.copy(), np.zeros(len(speed), dtype=bool)
    step = float(time[1] - time[0])
    for action in actions:
        motion = action.motion
        if motion.flight is not None:
            span = (motion.flight[0] - SETTLE, motion.flight[1])
        else:
            span = (motion.stops or 0.0, motion.moves_again)
        first, behind = (
            min(max(round((action.begin + at - time[0]) / step), 0), len(speed) - 1) for at in span
        )
        if first >= behind:
            continue
        pace = np.full(behind - first, speed[first])
        if motion.flight is None:
            pace = np.maximum(pace - BRAKE * step * np.arange(behind - first), 0.0)
        rest = behind + round(RECOVERY / step)
        back = np.linspace(0.0, 1.0, rest - behind)
        back = (back**2 * (3.0 - 2.0 * back))[: len(speed) - behind]
        speed[behind:rest] = (1.0 - back) * pace[-1] + back * speed[behind:rest]
        speed[first:behind] = pace
        steady[first:behind] = True
    return speed, steady
