"""Progress reports of a run."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final, Self

from flows.review.metric_words import all_reasons, in_short

logger = logging.getLogger("worldpose.run")

EXPECTATION_SECONDS: Final = 60.0
"""Measured computation time that counts as much as the expected one for the time left [s]: a first
unit that takes a hundred times its expected time says little about other stages."""
MOST_UNFINISHED: Final = 0.8
"""Share of a unit's expected time that counts as done before the unit is."""
MOST_TOLD: Final = 200
"""Units of a stage that are reported one by one; of more, only every n-th."""


@dataclass(frozen=True)
class Progress:
    """How far something is; the time left [s] is None before anything is done."""

    share: float
    seconds_left: float | None

    @classmethod
    def after(cls, share: float, began: float) -> Self:
        """Return the progress of what began at a time of the monotonic clock [s]."""
        elapsed = time.monotonic() - began
        return cls(share, elapsed * (1.0 - share) / share if share > 0.0 else None)

    def __str__(self) -> str:
        """Return percent and time left, at most 13 characters."""
        percent = f"{100.0 * self.share:.0f} %"
        if self.seconds_left is None or self.share >= 1.0:
            return percent
        return f"{percent} {format_duration(self.seconds_left)}"


def format_duration(seconds: float) -> str:
    """Format a duration in at most 7 characters."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    if seconds < 99.5 * 60.0:
        return f"{seconds / 60.0:.0f} min"
    if seconds < 99.5 * 3600.0:
        return f"{seconds / 3600.0:.1f} h"
    return f"{seconds / 86400.0:.0f} d"


class Reporter:
    """Reports progress as log lines, which a Prefect server shows with the run.

    The command line installs its own reporter, which calls this one too.
    """

    current: ClassVar[Reporter | None] = None
    """The reporter of this process's run, for other threads."""
    left: int = 0
    every: int = 1
    _work: Mapping[str, float] = MappingProxyType({})
    _reached: tuple[str, ...] = ()
    _missing: int = 0
    _began: float | None = None
    _stage_began: float = 0.0
    _moved: float = 0.0
    """Time at which the stage began or a unit of it ended [s]."""

    def run_planned(self, work: Mapping[str, float]) -> None:
        """Begin to measure a run, by expected times of stages' missing units, all workers [s]."""
        self._work, self._reached, self._missing, self._began = dict(work), (), 0, None

    @property
    def stage(self) -> str:
        """The current stage; empty before the first."""
        return self._reached[-1] if self._reached else ""

    @property
    def stage_progress(self) -> Progress:
        """How far the current stage is."""
        share = 1.0 - self.left / self._missing if self._missing else 1.0
        return Progress.after(min(max(share, 0.0), 1.0), self._stage_began)

    @property
    def run_progress(self) -> Progress:
        """How far the run is, by the expected work; as the stage without a plan."""
        total = sum(self._work.values())
        if not total:
            return self.stage_progress
        if self._began is None:  # all stages so far had their results
            return Progress(0.0, None)
        done = sum(self._work.get(stage, 0.0) for stage in self._reached[:-1])
        own = self._work.get(self._reached[-1], 0.0)
        done += own * self.stage_progress.share
        if self.left > 0:  # a unit may take minutes: it is on its way until it is nearly due
            due = own / self._missing
            done += min(time.monotonic() - self._moved, MOST_UNFINISHED * due)
        share = min(done / total, 1.0)
        if not done:
            return Progress(share, None)
        elapsed = time.monotonic() - self._began
        slowness = (elapsed + EXPECTATION_SECONDS) / (done + EXPECTATION_SECONDS)
        return Progress(share, (total - done) * slowness)

    def say(self, text: str) -> None:
        """Report any other slow operation."""
        logger.info(text)

    def tell_kept_settings(self, text: str) -> None:
        """Report the settings that a run takes over from the latest one."""
        logger.info(text)

    def stage_started(self, stage: str, about: str, *, units: int, missing: int) -> None:
        """Report that a stage starts, with the numbers of its units and of those to compute."""
        self.left, self.every = missing, max(1, math.ceil(missing / MOST_TOLD))
        self._missing, self._stage_began = missing, time.monotonic()
        self._moved = self._stage_began
        self._reached = (*self._reached, stage)
        if missing and self._began is None:
            self._began = self._stage_began
        logger.info("%s: %s (%d units, %d to compute)", stage, about, units, missing)

    def unit_done(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Report that a unit has been computed and published."""
        self.left, self._moved = self.left - 1, time.monotonic()
        if self.left % self.every == 0:
            self.tell_of(unit, seconds, figures)

    def tell_of(self, unit: str, seconds: float, figures: Mapping[str, float]) -> None:
        """Report that a unit is done; with very many units, only every n-th."""
        logger.info("%s: done in %.2f s (%s)", unit, seconds, in_short(figures))

    def unit_waits(self, unit: str, reasons: Sequence[str]) -> None:
        """Report that a unit's result needs review."""
        logger.warning("%s: waits for review: %s", unit, all_reasons(reasons))

    def unit_failed(self, unit: str, message: str) -> None:
        """Report that a unit has no result."""
        self.left, self._moved = self.left - 1, time.monotonic()
        logger.error("%s: failed: %s", unit, message)

    def report_interruption(self) -> None:
        """Report that the user ended the run; its process ends next."""
        logger.warning("interrupted")


_reporter: ContextVar[Reporter | None] = ContextVar("reporter", default=None)


def reporter() -> Reporter:
    """Return the reporter of the current run."""
    return _reporter.get() or Reporter()


@contextmanager
def reporting_to(target: Reporter) -> Iterator[None]:
    """Send progress of runs started in this context to `target`."""
    token, before = _reporter.set(target), Reporter.current
    Reporter.current = target
    try:
        yield
    finally:
        Reporter.current = before
        _reporter.reset(token)
