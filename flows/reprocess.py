"""Recomputation of all results that edits made stale, match by match."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Literal

from data_contracts.run import RunRecord
from flows.iterate import iterate_match
from flows.overview import read_summary
from flows.progress import reporter
from flows.results.automatic_exports import export_after_run
from flows.run_plan import PlannedUnit
from flows.run_record import AtWorkError, alone_with
from flows.run_status import RunStatus, run_status
from flows.running import RunRequest, run_match, settle, shared_machines
from worldpose.errors import InternalError, WorldposeError
from worldpose.store.store import Store

State = Literal[
    "never run", "current", "stale", "at work", "complete", "waiting", "partial", "failed"
]


@dataclass(frozen=True)
class Reprocessed:
    """Outcome for one match.

    Attributes:
        state: never run and current: nothing to do; stale: not run, since only the check was
            requested; at work: not run, since another process runs it; otherwise the new run's
            state, or failed if there is none.
        status: what its latest run would recompute; None if that could not be determined.
        problem: why the check failed or no run was recorded.
    """

    match_id: str
    state: State
    status: RunStatus | None = None
    record: RunRecord | None = None
    problem: str | None = None


def reprocess_matches(
    store: Store,
    match_ids: Sequence[str],
    request: RunRequest,
    *,
    retry: bool = False,
    is_rehearsal: bool = False,
) -> Iterator[Reprocessed]:
    """Run every match with stale results, up to the last stage of its latest run; yield outcomes.

    A match is run with the settings that its layers give. A failure is reported for its match, and
    does not stop the others. No id means all matches. `retry` also retries
    failed units without an edit; a rehearsal only determines what would be done.
    """
    with shared_machines(store, request) as machines_for:
        for match_id in match_ids or store.matches():
            yield _reprocess(store, match_id, request, machines_for, retry, is_rehearsal)


def _reprocess(
    store: Store,
    match_id: str,
    request: RunRequest,
    machines_for: Callable[[Iterable[PlannedUnit]], RunRequest],
    retry: bool,
    is_rehearsal: bool,
) -> Reprocessed:
    status = None
    try:
        if not request.settings:
            found = read_summary(store, match_id)  # as cheap as it is exact
            latest, failed = found.latest, bool(found.latest and found.latest.failed)
            if found.is_silent:
                return Reprocessed(match_id, "failed", problem=found.problem)
            if found.is_settled and not (retry and failed):
                return Reprocessed(match_id, "current" if latest else "never run", record=latest)
        with nullcontext() if is_rehearsal else alone_with(store, match_id):
            status = run_status(store, match_id, request.settings, retry=retry)
            if status is None:
                return Reprocessed(match_id, "never run")
            if not status.is_stale:
                return Reprocessed(match_id, "current", status, status.latest)
            if is_rehearsal:
                return Reprocessed(match_id, "stale", status, status.latest)
            reporter().say(f"{match_id}: {len(status.to_compute)} units to compute")
            request = machines_for(status.to_compute)
            request = replace(request, until_stage=status.until_stage, gates=status.gates)
            match, request = settle(store, status.match, request)
            if request.most_iterations == 1:
                record = run_match(store, match, request)
            else:
                record = iterate_match(store, match, request, request.most_iterations).record
            try:
                export_after_run(store, match, record)
            except (WorldposeError, OSError) as failure:
                return Reprocessed(match_id, record.state, status, record, problem=str(failure))
    except AtWorkError as refusal:
        return Reprocessed(match_id, "at work", problem=str(refusal))
    except Exception as failure:  # any error, so that the other matches continue
        text = str(failure)
        if not isinstance(failure, WorldposeError | OSError):
            text = str(InternalError.wrap(match_id, failure))
        reporter().say(f"{match_id} failed: {text}")
        return Reprocessed(match_id, "failed", status, problem=text)
    return Reprocessed(match_id, record.state, status, record)
