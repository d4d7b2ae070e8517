"""Recomputation of all results that edits made stale, match by match."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from data_contracts.run import RunRecord
from flows.iterate import iterate_match
from flows.planning import PlannedUnit
from flows.progress import reporter
from flows.running import RunRequest, run_match, shared_machines
from flows.touched import Touched, find_touched
from worldpose.errors import InternalError, WorldposeError
from worldpose.store import Store

State = Literal["never run", "untouched", "touched", "complete", "waiting", "partial", "failed"]


@dataclass(frozen=True)
class Reprocessed:
    """Outcome for one match.

    Attributes:
        match_id: the match.
        state: never run and untouched: nothing to do; touched: stale, but not run; otherwise the
            new run's state, or failed if there is none.
        touched: stale results of the match; None if they could not be determined.
        record: record of the current run.
        problem: why the check failed or no run was recorded.
    """

    match_id: str
    state: State
    touched: Touched | None = None
    record: RunRecord | None = None
    problem: str | None = None


def reprocess_matches(
    store: Store,
    match_ids: Sequence[str],
    request: RunRequest,
    *,
    retry: bool = False,
    is_rehearsal: bool = False,
) -> list[Reprocessed]:
    """Run every match with stale results, up to the last stage of its latest run.

    A match is run with the settings, gates and iterations of its latest run. A failure is reported
    for its match, and does not stop the others.

    Args:
        store: the project.
        match_ids: registered matches; empty = all.
        request: further settings for each, and the machines.
        retry: retry failed units, even without an edit.
        is_rehearsal: only determine what would be done.
    """
    with shared_machines(store, request) as machines_for:
        return [
            _reprocess(store, match_id, request, machines_for, retry, is_rehearsal)
            for match_id in match_ids or store.matches()
        ]


def _reprocess(
    store: Store,
    match_id: str,
    request: RunRequest,
    machines_for: Callable[[Iterable[PlannedUnit]], RunRequest],
    retry: bool,
    is_rehearsal: bool,
) -> Reprocessed:
    touched = None
    try:
        touched = find_touched(store, match_id, request.settings, retry=retry)
        if touched is None:
            return Reprocessed(match_id, "never run")
        if not touched.is_touched:
            return Reprocessed(match_id, "untouched", touched, touched.latest)
        if is_rehearsal:
            return Reprocessed(match_id, "touched", touched, touched.latest)
        reporter().say(f"{match_id}: {len(touched.to_compute)} units to compute")
        record = _run(store, touched, machines_for(touched.to_compute))
    except Exception as failure:  # any error, so that the other matches continue
        text = str(failure)
        if not isinstance(failure, WorldposeError | OSError):
            text = str(InternalError.wrapping(match_id, failure))
        reporter().say(f"{match_id} failed: {text}")
        return Reprocessed(match_id, "failed", touched, problem=text)
    return Reprocessed(match_id, record.state, touched, record)


def _run(store: Store, touched: Touched, request: RunRequest) -> RunRecord:
    latest = touched.latest
    request = replace(
        request,
        settings=touched.settings,
        until_stage=touched.until_stage,
        gates=latest.gates,
    )
    if latest.iteration == 1:
        return run_match(store, touched.match, request)
    return iterate_match(store, touched.match, request, latest.iteration).record
