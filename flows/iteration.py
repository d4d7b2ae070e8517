"""The method again and again, each time with what the bodies of the time before contradicted (R1).

Calibrate, track, adjust, fit, film, filter; then again from tracking, with cameras that agree with
people (C6) and without the keypoints and boxes that no body fits (R2). Every iteration is a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final

from data_contracts.run import RunRecord
from flows.basis import basis_of
from flows.edit_conflicts import EditedMeanwhileError
from flows.gatekeeping import Gatekeeper
from flows.method import METHOD
from flows.outlook import Outlook, look_ahead
from flows.planning import PlannedUnit
from flows.progress import reporter
from flows.registering import open_match
from flows.run_record import latest_run
from flows.running import RunRequest, run_match, shared_machines
from flows.stage import Match
from worldpose.errors import UsageError
from worldpose.store import Store

GAIN: Final = 0.01
"""An iteration is better where it lowers the error in cameras that were left out by more than this
part: less is what rejecting the honest ends of a detector's errors brings by itself."""
MOST: Final = 6
"""Iterations that nobody asked for by number."""


@dataclass(frozen=True)
class Iteration:
    """One pass over the method.

    Attributes:
        number: from 1.
        record: of its run.
        held_out_error: mean distance of keypoints in cameras that were left out to where the
            others put people, all clips [box height]; None where left-out cameras cannot judge: two
            cameras alone, or nobody detected.
    """

    number: int
    record: RunRecord
    held_out_error: float | None

    def is_better_than(self, other: Iteration) -> bool:
        """Whether it lowers the held-out error by more than `GAIN`."""
        ours, theirs = self.held_out_error, other.held_out_error
        return ours is not None and (theirs is None or ours < (1.0 - GAIN) * theirs)


@dataclass(frozen=True)
class Iterations:
    """All passes that were made.

    Attributes:
        passes: in order.
        kept: the one whose results stand: each is kept only if it is better than the kept one.
        record: the latest run, that names those results; of the last pass where it did not end
            well.
        ended: why there was no further one.
    """

    passes: tuple[Iteration, ...]
    kept: Iteration
    record: RunRecord
    ended: str


def iterate_match(store: Store, match: Match, request: RunRequest, most: int | None) -> Iterations:
    """Runs the method `most` times over and lets the best iteration stand.

    What a run of an iteration holds already is not computed again; killed anywhere, the next call
    goes on from what is finished. Where the match is edited between two passes, they begin again
    with the edit, so that none is made from another state of the match than the next.

    Args:
        store: the store.
        match: the match.
        request: settings and machines, for every iteration.
        most: how many; None = until one is no better than the best before it.

    Raises:
        UsageError: only a part of the method was asked for.
    """
    if request.from_stage is not None or request.until_stage is not None:
        raise UsageError(
            "--iterations",
            expected="the whole method",
            found="--from or --until",
            todo="Leave these out, or --iterations.",
        )
    while True:
        try:
            return _iterate(store, match, request, most)
        except EditedMeanwhileError:
            reporter().say("the match was edited meanwhile: its iterations begin again")
            match = open_match(store, match.match_id)


def _iterate(store: Store, match: Match, request: RunRequest, most: int | None) -> Iterations:
    passes: list[Iteration] = []
    ended = "that many were asked for"
    with shared_machines(store, request) as machines_for:
        for number in range(1, (most or MOST) + 1):
            iteration = _pass(store, match, replace(request, iteration=number), machines_for)
            passes.append(iteration)
            if iteration.record.state != "complete":
                ended = f"iteration {number} is {iteration.record.state}"
                return Iterations(tuple(passes), _best(passes), iteration.record, ended)
            if most is None and _best(passes) is not iteration:
                ended = f"iteration {number} is no better"
                break
        if len(passes) > 1 and passes[-1].held_out_error is None:
            ended = "left-out cameras cannot judge which iteration is better"
        kept = _best(passes)
        latest = latest_run(store, match.match_id)
        record = kept.record
        if latest is None or latest.run_id != record.run_id:
            record = run_match(store, match, replace(request, iteration=kept.number))
    return Iterations(tuple(passes), kept, record, ended)


def _pass(
    store: Store,
    match: Match,
    request: RunRequest,
    machines_for: Callable[[Iterable[PlannedUnit]], RunRequest],
) -> Iteration:
    """One pass over the method: the run that has it already, or a new one."""
    outlook = _outlook(store, match, request)
    record = _recorded(store, match, outlook)
    if record is None:
        reporter().say(f"iteration {request.iteration}")
        machines = machines_for(outlook.missing)
        record = run_match(store, match, replace(machines, iteration=request.iteration))
    return Iteration(request.iteration, record, held_out_error(record))


def _outlook(store: Store, match: Match, request: RunRequest) -> Outlook:
    latest = latest_run(store, match.match_id)
    waits = latest is not None and latest.state == "waiting"
    policy = request.gates or (latest.gates if latest is not None and waits else "never")
    gatekeeper = Gatekeeper(store, match, policy)
    basis = basis_of(store, match, METHOD, request.settings, latest, request.iteration)
    return look_ahead(gatekeeper, request.settings, METHOD, basis)


def _recorded(store: Store, match: Match, outlook: Outlook) -> RunRecord | None:
    """The run, if any, that has all results of an iteration already, whichever came after it."""
    runs = (store.run(match.match_id, run_id) for run_id in reversed(store.runs(match.match_id)))
    found = next((run for run in runs if outlook.is_recorded_by(run)), None)
    if found is None:
        return None
    return found.model_copy(update={"executed": (), "reused": tuple(sorted(found.results))})


def _best(passes: list[Iteration]) -> Iteration:
    best = passes[0]
    for iteration in passes[1:]:
        if iteration.record.state == "complete" and iteration.is_better_than(best):
            best = iteration
    return best


def held_out_error(record: RunRecord) -> float | None:
    """The error in left-out cameras over all clips of a run [box height]."""
    clips = [
        (figures["held_out_error"], figures["held_out_keypoints"])
        for name, figures in record.figures.items()
        if name.startswith("filtering/") and "held_out_error" in figures
    ]
    weight = sum(keypoints for _, keypoints in clips)
    return sum(error * keypoints for error, keypoints in clips) / weight if weight else None
