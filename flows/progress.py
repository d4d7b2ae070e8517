"""Progress reports of a run."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

logger = logging.getLogger("worldpose.run")

MOST_TOLD: Final = 200
"""Units of a stage that are reported one by one; of more, only every n-th."""


class Reporter:
    """Reports progress as log lines, which a Prefect server shows with the run.

    The command line installs its own reporter, which calls this one too.

    Attributes:
        left: units of the current stage that have not ended.
        every: report every n-th finished unit.
    """

    left: int = 0
    every: int = 1

    def say(self, text: str) -> None:
        """Report any other slow operation."""
        logger.info(text)

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """Report that a stage starts, with the numbers of its units and of those to compute."""
        self.left, self.every = missing, max(1, math.ceil(missing / MOST_TOLD))
        logger.info("%s: %s (%d units, %d to compute)", stage, about, units, missing)

    def unit_done(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Report that a unit has been computed and published."""
        self.left -= 1
        if self.left % self.every == 0:
            self.tell_of(unit, seconds, figures)

    def tell_of(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Report that a unit is done; with very many units, only every n-th."""
        logger.info("%s: done in %.2f s (%s)", unit, seconds, in_short(figures))

    def unit_waits(self, unit: str, reasons: Sequence[str]) -> None:
        """Report that a unit's result needs review."""
        logger.warning("%s: waits for review: %s", unit, "; ".join(reasons))

    def unit_failed(self, unit: str, message: str) -> None:
        """Report that a unit has no result."""
        self.left -= 1
        logger.error("%s: failed: %s", unit, message)


def in_short(figures: Mapping[str, float]) -> str:
    """Format a unit's metrics on one line, without those of single cameras."""
    return ", ".join(f"{name} {value:.4g}" for name, value in figures.items() if "." not in name)


_reporter: ContextVar[Reporter | None] = ContextVar("reporter", default=None)


def reporter() -> Reporter:
    """Return the reporter of the current run."""
    return _reporter.get() or Reporter()


@contextmanager
def reporting_to(target: Reporter) -> Iterator[None]:
    """Send progress of runs started in this context to `target`."""
    token = _reporter.set(target)
    try:
        yield
    finally:
        _reporter.reset(token)
