"""Status of a project: matches by stage, with times, metrics, pending reviews and failures."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from typing import Final, Literal

from data_contracts.review import ReviewRecord, ReviewRequest
from data_contracts.run import RunRecord
from flows.gates import GATES
from flows.match_state import MatchState, describe_problem, match_state
from flows.method import METHOD
from flows.registering import open_for_review
from flows.results.timings import Cost
from flows.review.metric_words import all_reasons
from flows.run_record import latest_run
from worldpose.errors import WorldposeError
from worldpose.review.journal import last_decision, read_journal, requests_by_id
from worldpose.store.store import Store

UnitState = Literal["done", "waiting", "failed", "blocked"]

ALWAYS_READ: Final = 4
"""Matches that every look reads, unless there are `MANY`."""
MANY: Final = 100
"""Of more matches, a look reads no more than its time allows."""
REREAD_SECONDS: Final = 60.0
"""Age at which a status is read again without a change: a file can be damaged."""
BODIES = "body_fitting"
"""The stage whose bodies count as the poses of a project."""


@dataclass(frozen=True)
class UnitSummary:
    """One unit of a match's latest run.

    Attributes:
        unit: its name within the stage, often the id of a camera or clip.
        state: done; waiting for review; failed; blocked by a unit that is not done.
        seconds: computation time [s]; None if there is no result.
        figures: its quality metrics.
        objections: metrics beyond the gate's limits without an approval.
        waiting_since: time of the review request; None if there is none.
        why: reason for the failure or the review.
        bytes: size of the files of its result [byte].
    """

    unit: str
    state: UnitState
    seconds: float | None = None
    figures: Mapping[str, float] = field(default_factory=dict)
    objections: tuple[str, ...] = ()
    waiting_since: datetime | None = None
    why: str = ""
    bytes: int = 0


@dataclass(frozen=True)
class MatchStatus:
    """Status of one match.

    Attributes:
        match_id: its id.
        latest: its latest finished run.
        at_work_since: start of a run that has not ended.
        stages: stage to its units, in the order of the method.
        now: the state with what to do; None if it was not read.
        problem: why its status is not readable.
        is_unseen: whether it was not read yet.
    """

    match_id: str
    latest: RunRecord | None = None
    at_work_since: datetime | None = None
    stages: Mapping[str, tuple[UnitSummary, ...]] = field(default_factory=dict)
    now: MatchState | None = None
    problem: str = ""
    is_unseen: bool = False

    @property
    def state(self) -> str:
        """The latest run's state, or the state before the first run."""
        if self.is_unseen:
            return "being read"
        if self.problem:
            return "unreadable"
        if self.at_work_since is not None:
            return "at work"
        return "not run" if self.latest is None else self.latest.state

    @property
    def cost(self) -> Cost:
        """Core hours and bytes of all results of the latest run."""
        units = [unit for _, unit in self.units]
        seconds = sum(unit.seconds or 0.0 for unit in units)
        return Cost(seconds / 3600.0, sum(unit.bytes for unit in units))

    @property
    def units(self) -> Iterable[tuple[str, UnitSummary]]:
        """Yield all units with their stage."""
        return ((stage, unit) for stage, units in self.stages.items() for unit in units)


class Overview:
    """Repeated reads of a project's status; immutable data is read once.

    Only with states it opens match folders and plans their next runs, which takes longer.
    """

    def __init__(self, store: Store, *, with_states: bool = False) -> None:
        self.store, self.with_states = store, with_states
        self._manifest = cache(store.manifest)
        self._poses = cache(lambda match_id, run_id: _poses_of(store.run(match_id, run_id)))
        self._known: dict[str, tuple[object, MatchStatus]] = {}
        self._read_at: dict[str, float] = {}
        self._seen_at: dict[str, float] = {}

    def look(self, budget: float = math.inf) -> list[MatchStatus]:
        """Return the status of every match; an unreadable match does not affect others.

        After the budget [s] no further match is read; at least `ALWAYS_READ` are, those first that
        were not read for longest. The others have their last status.
        """
        names = self.store.matches()
        begun = time.monotonic()
        oldest = sorted(names, key=lambda name: self._seen_at.get(name, 0.0))
        for number, match_id in enumerate(oldest):
            is_late = time.monotonic() - begun > budget
            if is_late and number and (number >= ALWAYS_READ or len(names) > MANY):
                break
            try:
                self._match(match_id)
            except (OSError, WorldposeError) as error:
                self._known[match_id] = (None, MatchStatus(match_id, problem=str(error)))
            self._seen_at[match_id] = time.monotonic()
        unseen = (None, None)
        found = [(name, self._known.get(name, unseen)[1]) for name in names]
        return [status or MatchStatus(name, is_unseen=True) for name, status in found]

    def poses(self) -> list[tuple[datetime, float]]:
        """Return for each run of any match its end and the number of fitted bodies."""
        found = []
        for match_id in self.store.matches():
            for run_id in self.store.runs(match_id):
                with suppress(OSError, WorldposeError):  # `look` reports it
                    found.append(self._poses(match_id, run_id))
        return found

    def _match(self, match_id: str) -> None:
        """Read the status of a match again after a new run or journal entry, or when it is old."""
        begun = self.store.unfinished_runs(match_id)
        journal = read_journal(self.store, match_id)
        stamp = (journal.last, self.store.runs(match_id), tuple(each.run_id for each in begun))
        known, last, now = self._known.get(match_id), self._read_at, time.monotonic()
        is_old = now - last.get(match_id, -math.inf) > REREAD_SECONDS
        if known is None or known[0] != stamp or is_old:
            self._known[match_id] = (stamp, self._read(match_id))
            last[match_id] = now

    def _read(self, match_id: str) -> MatchStatus:
        latest = latest_run(self.store, match_id)
        begun = self.store.unfinished_runs(match_id)
        last = "" if latest is None else latest.run_id
        at_work = [each.started_at for each in begun if each.run_id > last]
        stages = {} if latest is None else self._stages(latest)
        now = state_now(self.store, match_id) if self.with_states else None
        return MatchStatus(match_id, latest, at_work[-1] if at_work else None, stages, now)

    def _stages(self, run: RunRecord) -> dict[str, tuple[UnitSummary, ...]]:
        records = read_journal(self.store, run.match_id).questions
        asked = requests_by_id(records)
        units: dict[str, list[UnitSummary]] = {}
        for name, glance in (
            *((name, self._result(run, name, records, asked)) for name in sorted(run.results)),
            *(
                (it.unit, UnitSummary(_unit(it.unit), "failed", why=it.message))
                for it in run.failed
            ),
            *((name, UnitSummary(_unit(name), "blocked")) for name in run.blocked),
        ):
            units.setdefault(name.partition("/")[0], []).append(glance)
        return {
            stage.name: tuple(sorted(units[stage.name], key=lambda unit: unit.unit))
            for stage in METHOD
            if stage.name in units
        }

    def _result(
        self,
        run: RunRecord,
        name: str,
        records: tuple[ReviewRecord, ...],
        asked: Mapping[str, ReviewRequest],
    ) -> UnitSummary:
        stage, _, unit = name.partition("/")
        manifest = self._manifest(run.match_id, stage, unit, run.results[name])
        decision = last_decision(records, name, manifest.content)
        is_approved = decision is not None and decision.verdict == "approve"
        gate = GATES.get(stage)
        objections = () if gate is None or is_approved else gate.objections(manifest.figures)
        waits = next((each for each in run.waiting if each.unit == name), None)
        done = UnitSummary(
            unit,
            "done",
            manifest.seconds,
            manifest.figures,
            objections,
            bytes=sum(file.size for file in manifest.files),
        )
        if waits is None or is_approved:
            return done
        request = asked.get(waits.request)
        since = run.finished_at if request is None else request.created_at
        return replace(done, state="waiting", waiting_since=since, why=all_reasons(waits.reasons))


def state_now(store: Store, match_id: str) -> MatchState:
    """Return the state of a match; of one that cannot be opened, the reason."""
    try:
        return match_state(store, open_for_review(store, match_id))
    except (OSError, WorldposeError) as error:
        return describe_problem(error)


def age(since: datetime | None) -> float:
    """Return the elapsed time [s]; never negative, even if the clock was changed."""
    return 0.0 if since is None else max(0.0, (datetime.now(UTC) - since).total_seconds())


def _unit(name: str) -> str:
    return name.partition("/")[2]


def _poses_of(run: RunRecord) -> tuple[datetime, float]:
    fitted = [name for name in run.executed if name.partition("/")[0] == BODIES]
    return run.finished_at, sum(run.figures.get(name, {}).get("bodies", 0.0) for name in fitted)
