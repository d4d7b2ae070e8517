"""How long a unit may be at work before it is taken for hung."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from flows.method import METHOD
from worldpose.errors import UsageError

LONGEST: Final = 360.0
"""Of a stage for which nothing else was said [min]; the longest unit yet took a tenth of it."""

TimeLimits = Mapping[str, float]
"""Stage to the minutes that each of its units may be at work."""


def seconds_of(stage: str, limits: TimeLimits) -> float:
    """How long a unit of the stage may be at work [s]."""
    return 60.0 * limits.get(stage, LONGEST)


def parse_time_limits(given: Sequence[str]) -> TimeLimits:
    """Limits given as minutes for every stage, or as `stage=minutes`; later ones win.

    Raises:
        UsageError: no such stage, or not a number of minutes.
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
                todo="For example: --time-limit detection=120.",
            )
        limits |= dict.fromkeys([stage] if equals else names, minutes)
    return limits
