"""Motions of standing people: shift weight, rest hands on hips, look around, wait."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_contracts.arrays import Floats
from worldpose.simulation.motions import Arm, Height, Motion, Stance, key, motion_of
from worldpose.simulation.moves import STANDING


def shift_weight(duration: float) -> Motion:
    """Return a shift of weight to the left leg, then to the right one."""

    def over(side: float) -> Floats:
        return key(
            turn=(0.0, 3.5 * side, 4.0 * side),
            bend=(4.0, -4.5 * side, -3.0 * side),
            away=(0.0, 0.045 * side),
        )

    return _held("shift", duration, [key(), over(1.0), over(1.0), over(-1.0), over(-1.0), key()])


def hands_on_hips(duration: float) -> Motion:
    """Return a rest with both hands on the hips, looking around."""
    arms = (Arm(-22.0, 46.0, 98.0, 76.0), Arm(-20.0, 44.0, 98.0, 76.0))

    def looking(yaw: float, aside: float) -> Floats:
        return key(bend=(2.0, 0.0, 0.15 * yaw), nod=(0.0, 0.0, yaw), away=(0.0, aside), arms=arms)

    looks = [looking(20.0, 0.02), looking(45.0, 0.03), looking(-35.0, -0.02)]
    return _held("hands on hips", duration, [key(), *looks, looking(0.0, 0.0), key()])


def look_around(duration: float) -> Motion:
    """Return turns of the head, followed by the chest, from side to side."""

    def looking(yaw: float) -> Floats:
        return key(bend=(3.0, 0.0, 0.25 * yaw), nod=(2.0, 0.0, yaw))

    return _held("look", duration, [key(), looking(60.0), looking(40.0), looking(-65.0), key()])


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
    motion = _held("ready", duration, [key(), *waiting, key()])
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


def _held(name: str, duration: float, keys: Sequence[Floats]) -> Motion:
    time, channels = motion_of(list(zip(np.linspace(0.0, duration, len(keys)), keys, strict=True)))
    return Motion(
        name, duration, time, channels, heights=(Height(0.0, STANDING - 0.005),), ease=(0.7, 0.7)
    )
