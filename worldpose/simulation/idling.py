"""Actions of standing people, and readiness of a goalkeeper."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.simulation.motions import Action
from worldpose.simulation.paths import GroundPath
from worldpose.simulation.settings import ActionRates
from worldpose.simulation.standing import hands_on_hips, look_around, ready, shift_weight

STANDING_SPEED: Final = 0.25
"""Slower people stand [m/s]."""
SHORTEST: Final = 1.6
"""Minimum duration of a rest with actions [s]."""
LONGEST: Final = (3.0, 6.0)
"""Range of the maximum duration of an action [s]."""
ALERT: Final = 35.0
"""Distance of the ball from the goal at which a goalkeeper gets ready [m]."""


def stand_about(path: GroundPath, rates: ActionRates, rng: np.random.Generator) -> GroundPath:
    """Return the path with actions while the person stands: shift weight, look, hands on hips."""
    motions = (shift_weight, look_around, hands_on_hips)
    actions = list(path.actions)
    for begin, end in _rests(path):
        while end - begin > SHORTEST:
            duration = min(end - begin, rng.uniform(*LONGEST))
            kind, left = rng.choice(len(motions), p=(0.5, 0.3, 0.2)), bool(rng.random() < 0.5)
            if rng.random() < rates.standing_about:
                actions.append(Action(begin, motions[kind](duration), left))
            begin += duration
    return replace(path, actions=_in_order(actions))


def keep_ready(path: GroundPath, goal: Floats, ball: Floats) -> GroundPath:
    """Return a goalkeeper's path, with readiness during rests while the ball is near.

    Args:
        path: of the goalkeeper.
        goal: (2,) [m].
        ball: (samples, 2) [m], at the path's times.
    """
    near = np.linalg.norm(ball - goal, axis=-1) < ALERT
    actions = list(path.actions)
    for begin, end in _rests(path, near):
        if end - begin > SHORTEST:
            actions.append(Action(begin, ready(end - begin)))
    return replace(path, actions=_in_order(actions))


def _rests(path: GroundPath, also: NDArray[np.bool_] | None = None) -> list[tuple[float, float]]:
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


def _in_order(actions: list[Action]) -> tuple[Action, ...]:
    return tuple(sorted(actions, key=lambda action: action.begin))
