"""Iterations of the method, each without the outliers that the previous bodies rejected.

Calibrate, track, adjust, fit, calibrate the broadcast camera, filter; then repeat from tracking,
with cameras adjusted to people and without the keypoints and boxes that no body fits.
Every iteration is a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Final

from data_contracts.run import RunRecord
from flows.gates import Gatekeeper
from flows.method import METHOD
from flows.progress import reporter
from flows.registering import open_match
from flows.review.edit_conflicts import EditedMeanwhileError
from flows.run_plan import PlannedUnit, RunPlan, plan_ahead
from flows.run_record import latest_run
from flows.run_status import MAX_ITERATIONS
from flows.running import RunRequest, require_whole, run_match, settle, shared_machines
from flows.stage import Match
from worldpose.store.store import Store

GAIN: Final = 0.01
"""Minimum relative decrease of the held-out error for a better iteration: rejecting the tails of
a detector's noise alone causes smaller decreases."""


@dataclass(frozen=True)
class Iteration:
    """One iteration of the method, with the record of its run.

    Attributes:
        number: iteration number, from 1.
        held_out_error: mean distance of keypoints in held-out cameras to the reprojection from the
            others, all clips [box height]; None with only two cameras, or no detections.
    """

    number: int
    record: RunRecord
    held_out_error: float | None


@dataclass(frozen=True)
class Iterations:
    """All iterations of a call.

    Each pass is accepted, `kept`, only if it is better than the last accepted one. The record is
    that of the latest run, which names the results of `kept`, or of a last pass that did not
    complete; `ended` says why there is no further pass.
    """

    passes: tuple[Iteration, ...]
    kept: Iteration
    record: RunRecord
    ended: str


def iterate_match(store: Store, match: Match, request: RunRequest, most: int | None) -> Iterations:
    """Run up to `most` iterations of the method and keep the best.

    Existing results are not computed again; after a kill, the next call resumes from the finished
    results. If the match is edited between two iterations, all restart with the edit, so that all
    iterations use the same state of the match. None iterates until an iteration is no better than
    the best before it. UsageError if only a part of the method was requested.
    """
    require_whole(request)
    match, request = settle(store, match, request)
    # All iterations ask as the first: that it is complete, ends no policy.
    policy = request.gate_policy(match, latest_run(store, match.match_id))
    request = replace(request, gates=policy)
    while True:
        try:
            return _iterate(store, match, request, most)
        except EditedMeanwhileError:
            reporter().say("the match was edited meanwhile: its iterations restart")
            match = open_match(store, match.match_id)


def _iterate(store: Store, match: Match, request: RunRequest, most: int | None) -> Iterations:
    passes: list[Iteration] = []
    ended = (
        "that many were requested" if most else f"the most iterations, {MAX_ITERATIONS}, are done"
    )
    with shared_machines(store, request) as machines_for:
        for number in range(1, (most or MAX_ITERATIONS) + 1):
            iteration = _pass(store, match, replace(request, iteration=number), machines_for)
            passes.append(iteration)
            if iteration.record.state != "complete":
                ended = f"iteration {number} is {iteration.record.state}"
                return Iterations(tuple(passes), _best(passes), iteration.record, ended)
            if most is None and _best(passes) is not iteration:
                ended = f"iteration {number} is no better"
                break
        if len(passes) > 1 and passes[-1].held_out_error is None:
            ended = "held-out cameras cannot tell which iteration is better"
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
    """Return the complete or latest run that has all results of an iteration, or a new run."""
    latest = latest_run(store, match.match_id)
    gatekeeper = Gatekeeper(store, match, request.gate_policy(match, latest))
    plan = plan_ahead(gatekeeper, METHOD, request.settings, latest, request.iteration)
    record = _recorded_run(store, match, plan)
    is_latest = record is not None and latest is not None and record.run_id == latest.run_id
    # Questions and failures are those of the latest run.
    if record is None or (record.state != "complete" and not is_latest):
        reporter().say(f"iteration {request.iteration}")
        machines = machines_for(plan.missing)
        record = run_match(store, match, replace(machines, iteration=request.iteration))
    return Iteration(request.iteration, record, held_out_error(record))


def _recorded_run(store: Store, match: Match, plan: RunPlan) -> RunRecord | None:
    """Return the newest run that has all results of an iteration, if any."""
    runs = (store.run(match.match_id, run_id) for run_id in reversed(store.runs(match.match_id)))
    found = next((run for run in runs if plan.is_recorded_by(run)), None)
    if found is None:
        return None
    return found.model_copy(update={"executed": (), "reused": tuple(sorted(found.results))})


def _best(passes: list[Iteration]) -> Iteration:
    """Return the last one that lowers the held-out error of the best before by over `GAIN`."""
    best = passes[0]
    for iteration in passes[1:]:
        ours, theirs = iteration.held_out_error, best.held_out_error
        is_better = ours is not None and (theirs is None or ours < (1.0 - GAIN) * theirs)
        if iteration.record.state == "complete" and is_better:
            best = iteration
    return best


def held_out_error(record: RunRecord) -> float | None:
    """Return the held-out error over all clips of a run [box height]."""
    clips = [
        (figures["held_out_error"], figures["held_out_keypoints"])
        for name, figures in record.figures.items()
        if name.startswith("filtering/") and "held_out_error" in figures
    ]
    weight = sum(keypoints for _, keypoints in clips)
    return sum(error * keypoints for error, keypoints in clips) / weight if weight else None
