"""Trajectory of a match's ball, and the touches of players."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from data_contracts.arrays import Floats
from worldpose.simulation.paths import STEP
from worldpose.simulation.settings import ActionRates

PASS_EVERY: Final = (2.0, 4.5)
"""Time between passes [s]."""
PASS_LENGTH: Final = 12.0
"""Standard deviation of a pass per axis [m]."""
SHOT_RANGE: Final = 28.0
"""Maximum distance from the goal for shots [m]."""
SHOT_SPEED: Final = 24.0
"""Mean speed of a shot on its way [m/s]; instep kicks of trained players leave at 25 to 34 m/s."""
GOAL_LINE: Final = 51.5
"""Where the goalkeeper catches shots [m]: before the line of a pitch of 105 m."""
HELD: Final = 2.0
"""Time that a goalkeeper keeps the ball [s]."""


@dataclass(frozen=True, eq=False)
class Touch:
    """A player's touch of the ball.

    Attributes:
        time: [s].
        place: (2,) [m].
        target: (2,) destination of the ball [m].
        kind: a kick on the ground; a header that two contest; a kick that an opponent slides into;
            a shot; a save.
    """

    time: float
    place: Floats
    target: Floats
    kind: Literal["pass", "header", "tackle", "shot", "save"]


@dataclass(frozen=True, eq=False)
class Ball:
    """Trajectory of the ball.

    Attributes:
        position: (samples, 2) [m], every `STEP`.
        touches: in temporal order.
    """

    position: Floats
    touches: tuple[Touch, ...]


def roll_ball(time: Floats, rates: ActionRates, rng: np.random.Generator) -> Ball:
    """Return a ball that goes from pass to pass and stays in play.

    Args:
        time: (samples,) [s], every `STEP`.
        rates: shares of headers, tackles and shots.
        rng: draws passes and touches.
    """
    place = rng.uniform(-1.0, 1.0, 2) * [30.0, 18.0]
    when, places, kinds = [float(time[0])], [place], ["pass"]
    while when[-1] < time[-1]:
        chance, across = rng.random(), rng.uniform(-3.3, 3.3)
        wait, way = rng.uniform(*PASS_EVERY), PASS_LENGTH * rng.standard_normal(2)
        goal = np.array([np.copysign(GOAL_LINE, place[0]), across])
        far = float(np.linalg.norm(goal - place))
        if kinds[-1] == "pass" and far < SHOT_RANGE and rng.random() < rates.shots:
            kinds[-1] = "shot"
            when += [when[-1] + far / SHOT_SPEED, when[-1] + far / SHOT_SPEED + HELD]
            places += [goal, goal]
            kinds += ["save", "pass"]
            place = goal
            continue
        # Play drifts back to the middle third instead of staying in a corner.
        place = np.clip(0.9 * place + way, [-46.0, -29.0], [46.0, 29.0])
        when.append(when[-1] + wait)
        places.append(place)
        high = chance < rates.headers
        kinds.append("header" if high else "tackle" if chance > 1.0 - rates.tackles else "pass")
    # Smoothed over a third of a second: the target of people's gaze must not jump.
    raw = np.stack([np.interp(time, when, axis) for axis in np.array(places).T], axis=-1)
    half = round(0.35 / STEP)
    kernel = np.hanning(2 * half + 1)
    padded = np.pad(raw, ((half, half), (0, 0)), mode="edge")
    position = [np.convolve(axis, kernel / kernel.sum(), mode="valid") for axis in padded.T]
    touches = tuple(
        Touch(when[n], places[n], places[n + 1], kinds[n])  # type: ignore[arg-type]
        for n in range(1, len(when) - 1)
    )
    return Ball(np.stack(position, axis=-1), touches)
