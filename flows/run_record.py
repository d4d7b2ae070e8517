"""The record of a run while it is being made."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Self

from data_contracts.run import RunRecord, UnitFailure
from flows.method import METHOD
from flows.planning import Overrides, PlannedUnit, settings_of
from flows.progress import reporter
from flows.stage import Match
from worldpose.errors import UsageError
from worldpose.store import Store, libraries


def latest_run(store: Store, match_id: str) -> RunRecord | None:
    """The match's latest finished run, None before the first."""
    return store.run(match_id) if store.runs(match_id) else None


def standing_results(store: Store, match_id: str, from_stage: str | None) -> dict[str, str]:
    """Results of the stages before `from_stage` as the latest run has them, stale or not.

    Raises:
        UsageError: there is no run with such results.
    """
    names = [stage.name for stage in METHOD]
    earlier = names[: names.index(from_stage)] if from_stage is not None else []
    latest = latest_run(store, match_id)
    found = {} if latest is None else latest.results
    standing = {name: key for name, key in found.items() if name.partition("/")[0] in earlier}
    if earlier and not standing:
        raise UsageError(
            f"--from {from_stage}",
            expected=f"a run of {match_id} with results of {', '.join(earlier)}",
            found="none",
            todo="Run without --from first.",
        )
    return standing


@dataclass
class RunLog:
    """What a run has reused, computed and failed at so far.

    `close` turns it into the stored record; until then the run is visible only as unfinished.
    """

    store: Store
    match: Match
    overrides: Overrides
    run_id: str
    parent: str | None
    results: dict[str, str]
    started_at: datetime
    started: float
    executed: list[str] = field(default_factory=list)
    reused: list[str] = field(default_factory=list)
    failed: list[UnitFailure] = field(default_factory=list)

    @classmethod
    def begin(
        cls, store: Store, match: Match, overrides: Overrides, from_stage: str | None = None
    ) -> Self:
        """A new run with its number reserved.

        Raises:
            UsageError: `from_stage` is given and there is no run to start from.
        """
        latest = latest_run(store, match.match_id)
        results = standing_results(store, match.match_id, from_stage)
        run_id = store.reserve_run(match.match_id)
        log = cls(
            store=store,
            match=match,
            overrides=overrides,
            run_id=run_id,
            parent=None if latest is None else latest.run_id,
            results=results,
            started_at=datetime.now(UTC),
            started=time.monotonic(),
        )
        log.reused += results
        return log

    def reuse(self, units: Iterable[PlannedUnit]) -> None:
        """Take over results that the store already holds."""
        for unit in units:
            self.results[unit.name] = unit.key
            self.reused.append(unit.name)

    def finished(self, unit: PlannedUnit, failure: BaseException | None) -> None:
        """Note that a unit's task has ended."""
        if failure is None:
            self.results[unit.name] = unit.key
            self.executed.append(unit.name)
            manifest = self.store.manifest(
                self.match.match_id, unit.recipe.stage, unit.recipe.unit, unit.key
            )
            reporter().unit_done(unit.name, manifest.seconds, manifest.figures)
        else:
            self.failed.append(
                UnitFailure(unit=unit.name, error=type(failure).__name__, message=str(failure))
            )
            reporter().unit_failed(unit.name, str(failure))

    def close(self) -> RunRecord:
        """Store the record: from here on the run counts."""
        last_stage = METHOD[-1].name
        state = "complete"
        if self.failed:
            reached = any(name.startswith(f"{last_stage}/") for name in self.results)
            state = "partial" if reached else "failed"
        figures = {}
        for name, key in self.results.items():
            stage, _, unit = name.partition("/")
            figures[name] = self.store.manifest(self.match.match_id, stage, unit, key).figures
        record = RunRecord(
            run_id=self.run_id,
            match_id=self.match.match_id,
            parent=self.parent,
            state=state,
            results=dict(sorted(self.results.items())),
            settings={
                stage.name: settings_of(stage, self.overrides).model_dump(mode="json")
                for stage in METHOD
            },
            overrides={stage: dict(values) for stage, values in self.overrides.items()},
            executed=tuple(sorted(self.executed)),
            reused=tuple(sorted(self.reused)),
            failed=tuple(sorted(self.failed, key=lambda failure: failure.unit)),
            figures=figures,
            versions=libraries(),
            started_at=self.started_at,
            finished_at=datetime.now(UTC),
            seconds=round(time.monotonic() - self.started, 3),
        )
        self.store.finish_run(record)
        return record
