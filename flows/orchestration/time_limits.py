"""Time limits after which a unit counts as hung."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from flows.method import METHOD
from worldpose.errors import UsageError

DEFAULT_MINUTES: Final = 360.0
"""Default limit of a stage [min]; the longest unit so far took a tenth of it."""

TimeLimits = Mapping[str, float]
"""Stage to the time limit of each of its units [min]."""


def seconds_of(stage: str, limits: TimeLimits) -> float:
    """Return the time limit of the stage's units [s]."""
    return 60.0 * limits.get(stage, DEFAULT_MINUTES)


def parse_time_limits(given: Sequence[str]) -> TimeLimits:
    """Parse limits given as minutes for every stage, or as `stage=minutes`; later ones win.

    Raises:
        UsageError: an unknown stage, or not a number of minutes.
    """
    limits: dict[str, float] = {}
    names = [stage.name for stage in METHOD]
    for text in given:
        stage, equals, number = text.rpartition("=")
        try:
            minutes = float(number)
        except ValueError:
            minutes = math.nan
        if not 0.0 < minutes < math.inf or (equals and stage not in names):
            raise UsageError(
                f"--time-limit {text}",
                expected=f"minutes, or stage=minutes with one of {', '.join(names)}",
                found=repr(text),
                todo="Write it as in: --time-limit detection=120.",
            )
        limits |= dict.fromkeys([stage] if equals else names, minutes)
    return limits
