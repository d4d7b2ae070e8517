"""Jumps and falls of wandering people, and their effect on the pace."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.simulation.motions import Action, Motion
from worldpose.simulation.moves import jump
from worldpose.simulation.settings import ActionRates
from worldpose.simulation.tumbles import fall

SETTLE: Final = 0.35
"""Time before take-off with constant pace [s]."""
JUMP_SPEED: Final = 2.5
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
        speed: (samples,) [m/s], which `steadied` changes to suit.
        rates: frequencies of actions.
        rng: draws them.
    """
    minutes = (time[-1] - time[0]) / 60.0
    count = rng.poisson(minutes * (rates.jumps + rates.falls))
    begins, draws = np.sort(rng.uniform(time[0], time[-1], count)), rng.random((count, 3))
    actions: list[Action] = []
    for begin, (kind, size, side) in zip(begins, draws, strict=True):
        jumps = kind * (rates.jumps + rates.falls) < rates.jumps
        motion: Motion = jump(0.28 + 0.17 * size) if jumps else fall()
        pace = float(np.interp(begin, time, speed))
        suits = pace < JUMP_SPEED if jumps else 1.0 < pace < 5.0
        if suits and (not actions or begin > actions[-1].end):
            actions.append(Action(float(begin), motion, bool(side < 0.5)))
    return tuple(actions)


def steadied(
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
