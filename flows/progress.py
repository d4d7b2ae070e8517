"""Progress of a run, told to whoever started it."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

logger = logging.getLogger("worldpose.run")

MOST_TOLD: Final = 200
"""Units of a stage that are told of; of more, every so-manieth: nobody reads thousands of lines."""


class Reporter:
    """Tells progress as log lines, which a Prefect server shows with the run.

    The command line puts a livelier one in its place, which tells this one too.

    Attributes:
        left: units of the stage at work that are still to end.
        every: of how many that are done one is told of.
    """

    left: int = 0
    every: int = 1

    def say(self, text: str) -> None:
        """Anything else that takes a while."""
        logger.info(text)

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """A stage begins: how many units it has and how many must be computed."""
        self.left, self.every = missing, max(1, math.ceil(missing / MOST_TOLD))
        logger.info("%s: %s (%d units, %d to compute)", stage, about, units, missing)

    def unit_done(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """A unit has been computed and published."""
        self.left -= 1
        if self.left % self.every == 0:
            self.tell_of(unit, seconds, figures)

    def tell_of(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Say that a unit is done; where there are very many, not of each."""
        logger.info("%s: done in %.2f s (%s)", unit, seconds, in_short(figures))

    def unit_waits(self, unit: str, reasons: Sequence[str]) -> None:
        """A unit's result waits for a person."""
        logger.warning("%s: waits for review: %s", unit, "; ".join(reasons))

    def unit_failed(self, unit: str, message: str) -> None:
        """A unit has no result."""
        self.left -= 1
        logger.error("%s: failed: %s", unit, message)


def in_short(figures: Mapping[str, float]) -> str:
    """A unit's figures on one line, without those of single cameras."""
    return ", ".join(f"{name} {value:.4g}" for name, value in figures.items() if "." not in name)


_reporter: ContextVar[Reporter | None] = ContextVar("reporter", default=None)


def reporter() -> Reporter:
    """The reporter of the run under way."""
    return _reporter.get() or Reporter()


@contextmanager
def reporting_to(target: Reporter) -> Iterator[None]:
    """Let runs started in this context tell `target` of their progress."""
    token = _reporter.set(target)
    try:
        yield
    finally:
        _reporter.reset(token)
