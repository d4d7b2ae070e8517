"""State of a match with the one thing to do: pages, commands and alerts say the same."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Final, Literal

from data_contracts.review import Correction, NamedTrack, Withdrawal
from data_contracts.run import RunRecord, UnitFailure
from flows.review.descriptions import is_first_click
from flows.review.verdicts import still_waiting
from flows.run_plan import PlannedUnit, plan_run
from flows.run_record import expected_work, latest_run, runs_at_work
from flows.run_status import (
    Cause,
    UnitState,
    last_iteration,
    plan_as_latest,
    unit_state,
    unit_status,
)
from flows.settings import resolve
from flows.stage import Match
from worldpose.errors import WorldposeError
from worldpose.ingest.match_folder import unclicked_clips
from worldpose.review.journal import Journal
from worldpose.store.recipes import RecipeDifference
from worldpose.store.runs import run_order
from worldpose.store.store import Store

StateName = Literal[
    "running", "calibrate", "questions", "outdated", "stopped", "failed", "partial", "new", "ready"
]
UNREADABLE: Final = "cannot be opened"
"""Words of a match that cannot be opened or planned."""
NEEDS_FILES: Final = (
    "Add files: 2D poses of another tool, another calibration, or other offsets of the cameras. "
    "A run then begins by itself; no answer makes these results usable."
)
"""What to do about results that are not usable."""
START_SECONDS: Final = 10.0
"""Time until a run computes: its processes start [s]."""


@dataclass(frozen=True)
class MatchState:
    """The one true state of a match: its kind, a few words such as `2 questions`, and why.

    Attributes:
        why: the reason, in sentences; empty if the words say all.
        todo: what a person can do.
        seconds: expected time of the next run [s]; None if it computes nothing or is unknown.
        units: the match's units, as `stage/unit`, by their state relative to the latest run.
    """

    name: StateName
    words: str
    why: str = ""
    todo: str = ""
    seconds: float | None = None
    units: Mapping[UnitState, tuple[str, ...]] = field(default_factory=dict)


def match_state(store: Store, match: Match) -> MatchState:
    """Return the state of a match; InputError if the latest run's settings name a missing file."""
    latest = latest_run(store, match.match_id)
    units: dict[UnitState, tuple[str, ...]] = {}
    plan: list[PlannedUnit] = []
    if latest is not None or not match.folder.to_click:
        plan = plan_as_latest(store, match, latest, {})
        states = [(unit.name, unit_state(unit, latest)) for unit in plan]
        units = {state: tuple(n for n, its in states if its == state) for state in UnitState}
    missing = [unit for unit in plan if not unit.published]
    further: list[PlannedUnit] = []
    if latest and not missing:
        ahead = resolve(match.layers)
        for number in range(latest.iteration + 1, last_iteration(latest, ahead) + 1):
            then = plan_run(store, match, ahead.overrides, iteration=number)
            further += [unit for unit in then if not unit.published]
    found = _find(store, match, latest, units, plan, further)
    missing += further
    seconds = None
    if found.name in ("outdated", "stopped", "new") and missing:
        work = sum(expected_work(store, match, missing, latest).values())
        seconds = START_SECONDS + work / max(1, os.cpu_count() or 1)
    return replace(found, seconds=seconds, units=units)


def _find(
    store: Store,
    match: Match,
    latest: RunRecord | None,
    units: Mapping[UnitState, tuple[str, ...]],
    plan: list[PlannedUnit],
    further: list[PlannedUnit],
) -> MatchState:
    at_work, stopped = _open_runs(store, match.match_id, latest)
    to_click = (*match.folder.to_click, *(unclicked_clips(match.folder) if latest is None else ()))
    if at_work:
        return MatchState("running", "running")
    if to_click:
        names = ", ".join(to_click[:8]) + ", ..." * (len(to_click) > 8)
        todo = "Click about ten pitch markings in each of them."
        return MatchState("calibrate", "needs calibration", f"Not calibrated: {names}.", todo)
    waiting = still_waiting(store, match, latest)
    if waiting:
        rejected = [each.unit for each in waiting if each.rejected]
        if len(rejected) == len(waiting):
            words = _count(len(rejected), "result was rejected", "results were rejected")
            return MatchState("questions", words, todo="Correct it, then run again.")
        words = _count(len(waiting) - len(rejected), "question", "questions")
        if latest is not None and _are_people_lost(latest):
            return MatchState("questions", f"not usable, {words}", todo=NEEDS_FILES)
        return MatchState("questions", words, todo="Answer, then the run goes on by itself.")
    if stopped:
        why = f"Run {stopped} ended before it was recorded; its finished steps are kept."
        return MatchState("stopped", "stopped before its end", why, "Continue it.")
    if latest is None:
        return MatchState("new", "not run yet", todo="Run it.")
    why = _why_outdated(store, match, latest, units, plan)
    if why:
        before = ""
        if latest.failed:
            words, reason, _ = _describe_failure(latest)
            before = f"The last run {words.replace(':', ' in')}. {reason}"
        return MatchState("outdated", f"out of date {why}", before, "Run it again.")
    if latest.failed and latest.state == "failed":
        return MatchState("failed", *_describe_failure(latest))
    if latest.state == "partial":
        return MatchState("partial", *_describe_part(latest))
    if units[UnitState.MISSING]:
        why = "The last run was asked to end earlier."
        return MatchState("stopped", "not run to the end", why, "Continue it.")
    if further:
        count = _count(further[-1].iteration, "iteration is", "iterations are")
        why = f"{count} to be run by the settings, and not all of them were."
        return MatchState("outdated", "out of date because of its iterations", why, "Run it again.")
    usability = latest.usability
    words = "ready" if usability.verdict == "usable" else usability.verdict
    why = " ".join(usability.reservations)
    todo = NEEDS_FILES if usability.verdict == "not usable" else "Download the results."
    return MatchState("ready", words, why, todo)


def _are_people_lost(latest: RunRecord) -> bool:
    """Return whether no answer makes the results of a run usable: its tracks miss most people."""
    most = latest.usability.limits.max_unusable_share
    tracked = [own for unit, own in latest.figures.items() if unit.startswith("tracking/")]
    shares = ("absent_share", "unmatched_share")
    return any(own.get(name, 0.0) > most for own in tracked for name in shares)


def _open_runs(store: Store, match_id: str, latest: RunRecord | None) -> tuple[bool, str]:
    """Return whether a run is at work, and the number of one that ended without a record."""
    here = {run.run_id for run in runs_at_work(store, match_id)}
    stopped = ""
    for run in store.unfinished_runs(match_id):
        is_own = run.host == platform.node() and run.pid == os.getpid()
        is_earlier = latest is not None and run_order(run.run_id) < run_order(latest.run_id)
        if is_earlier and run.run_id not in here:
            continue
        if run.run_id in here or is_own or run.host != platform.node():
            return True, ""
        stopped = run.run_id
    return False, stopped


def corrections_since(journal: Journal, moment: datetime, until: datetime | None = None) -> int:
    """Return the number of corrections made or withdrawn since a time, without names."""
    changed: set[str] = set()
    for record in journal.records:
        if isinstance(record, Correction):
            at, name = record.made_at, record.id
        elif isinstance(record, Withdrawal):
            at, name = record.withdrawn_at, record.correction
        else:
            continue
        if at > moment and (until is None or at <= until):
            changed ^= {name}
    made = (journal.corrections[name] for name in changed)
    return sum(not isinstance(each.edit, NamedTrack) and not is_first_click(each) for each in made)


def _why_outdated(
    store: Store,
    match: Match,
    latest: RunRecord,
    units: Mapping[UnitState, tuple[str, ...]],
    plan: list[PlannedUnit],
) -> str:
    """Return why the latest run is out of date, as the end of a sentence; empty if it is not."""
    differing = {*units[UnitState.STALE], *units[UnitState.READY]}
    if latest.state == "waiting":  # every question has its answer
        differing |= {*units[UnitState.MISSING]}
    keys = {unit.name: unit.key for unit in plan}
    repaired = {each.unit for each in latest.failed if keys.get(each.unit) not in (None, each.key)}
    withdrawn = {name for name in units[UnitState.MISSING] if name in latest.results}
    if not differing | repaired | withdrawn:
        return ""
    count = corrections_since(match.journal, latest.started_at)
    if count:
        return f"because of {_count(count, 'correction', 'corrections')}"
    if latest.state == "waiting" and not units[UnitState.STALE]:
        return "because its questions are answered"
    if withdrawn and not differing:
        return "because results were removed"
    if repaired and not differing:
        return "because the input of the failed step has changed"
    if plan[0].iteration < latest.iteration:
        return "because of its iterations"
    return f"because {_first_cause(store, latest, plan)}"


_CAUSES: Final[Mapping[str, str]] = {
    "module": "worldpose has changed",
    "library": "a library has changed",
    "setting": "settings have changed",
    "source": "its files have changed",
}


def _first_cause(store: Store, latest: RunRecord, plan: list[PlannedUnit]) -> str:
    """Return the cause in the first unit whose recipe differs from that of the run."""
    for unit in plan:
        if unit_state(unit, latest) == UnitState.CURRENT:
            continue
        for reason in unit_status(store, unit, latest).own_reasons:
            if isinstance(reason, RecipeDifference) and reason.kind in _CAUSES:
                is_edit = reason.name.startswith(("edits", "identities"))
                if reason.kind == "source" and reason.name.partition(".")[0] == "pitch":
                    return "its pitch has changed"
                return "corrections have changed" if is_edit else _CAUSES[reason.kind]
            if isinstance(reason, Cause) and reason != Cause.NOT_COMPUTED:
                return "results were removed"
    return "results of an earlier run fit better"


def _describe_failure(record: RunRecord) -> tuple[str, str, str]:
    """Return words, reason and advice about a run whose units failed."""
    first, *others = record.failed
    waits = _count(len(record.blocked), "later step waits", "later steps wait")
    further = f" {_count(len(others), 'other step', 'other steps')} failed too." if others else ""
    further += f" {waits} for it." if record.blocked else ""
    why = " ".join(first.message.split())
    why = why if why.endswith((".", "!", "?")) else f"{why}."
    todo = "Correct the cause, then run again: finished steps are kept."
    return f"failed: {step_words(first)}", why + further, todo


def _describe_part(record: RunRecord) -> tuple[str, str, str]:
    """Return words, reason and advice about a partial run."""
    if record.failed:
        _, why, todo = _describe_failure(record)
        names = ", ".join(step_words(each) for each in record.failed[:3])
        return f"partial: {names} is missing", why, todo
    missing = "people in 3D" if not record.blocked else "the later steps"
    causes = [each for each in record.warnings if each.startswith("tracking/")]
    why = " ".join(causes or record.warnings)
    return f"partial: {missing} are missing", why, "Download what is there, or correct the cause."


def step_words(failure: UnitFailure) -> str:
    """Return a failed step in words: `tracking of clip`."""
    stage, _, unit = failure.unit.partition("/")
    return f"{stage.replace('_', ' ')} of {unit}"


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


def describe_problem(error: OSError | WorldposeError) -> MatchState:
    """Return the state of a match that cannot be opened or planned."""
    return MatchState("failed", UNREADABLE, str(error))
