"""Review of results: pending requests, verdicts, and the continuation of a run."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from pydantic import JsonValue

from data_contracts.review import (
    Correction,
    Edit,
    MovedPoint,
    Origin,
    RedrawnMarking,
    ReviewDecision,
    ReviewRequest,
    Withdrawal,
)
from data_contracts.run import RunRecord, WaitingUnit
from flows.gates import GATES
from flows.left_out import left_out_cameras
from flows.method import METHOD
from flows.orchestration.prefect_environment import has_server
from flows.review.corrections import new_corrections, objections_of
from flows.review.edit_conflicts import StaleEditError
from flows.run_record import latest_run
from flows.stage import Match
from worldpose.errors import InputError, StoreError
from worldpose.review.detections import DETECTION_EDITS
from worldpose.review.identities import TRACK_EDITS
from worldpose.review.journal import Journal, last_decision, requests_by_id, say
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Run, Store

State = Literal["waits", "corrected", "approve", "reject", "superseded"]


@dataclass(frozen=True)
class Review:
    """A review request and its verdict.

    `decision` is the last verdict on exactly these bytes. `is_current` says whether the latest run
    has the result, `is_asked` whether it waits for this review, and `is_corrected` whether
    corrections since then make the next run compute the result again.
    """

    request: ReviewRequest
    decision: ReviewDecision | None
    is_current: bool
    is_asked: bool
    is_corrected: bool = False

    @property
    def state(self) -> State:
        """The verdict; without one, whether it is pending, corrected or superseded.

        A rejected result that was corrected needs no other verdict: it is computed again.
        """
        is_approved = self.decision is not None and self.decision.verdict == "approve"
        if self.is_current and self.is_corrected and not is_approved:
            return "corrected"
        if self.decision is not None:
            return self.decision.verdict
        return "waits" if self.is_asked else "superseded"

    @property
    def question(self) -> str:
        """The decision for the reviewer."""
        gate = GATES.get(self.request.gate)
        return "Is it good enough to be built upon?" if gate is None else gate.question

    @property
    def consequences(self) -> dict[str, str]:
        """What approving and rejecting will do."""
        gate = GATES.get(self.request.gate)
        fix = "its input" if gate is None else gate.to_correct
        uses = "uses it as it is"
        if self.request.gate == "camera_consistency":
            uses = "leaves these cameras out"
        elif self.request.figures.get("clicks_wrong"):
            uses = "uses the camera without the clicks that contradict the others"
        return {
            "approve": f"Approve: the run goes on and {uses}.",
            "reject": f"Reject: nothing later uses it. Correct {fix}; then it is computed again.",
        }


def reviews_of(store: Store, match: Match, latest: RunRecord | None) -> list[Review]:
    """Return all of a match's review requests, first to last."""
    return _reviews(match.journal, latest, corrected_units(store, match, latest))


def corrected_units(store: Store, match: Match, latest: RunRecord | None) -> frozenset[str]:
    """Return the units waiting for review that the next run will compute from corrected data.

    A unit counts if the data of the match folder, with all corrections, differ from those that the
    unit or one of its inputs was computed from. Other code or libraries do not count.
    """
    if latest is None or not latest.waiting:
        return frozenset()
    once = ("corrected_units", latest.run_id)  # a page asks several times
    return match.once(once, lambda: _find_corrected(store, match, latest))


def _find_corrected(store: Store, match: Match, latest: RunRecord) -> frozenset[str]:
    results = latest.results
    held = {unit.unit for unit in latest.waiting}
    usable = {name: key for name, key in results.items() if name not in held}
    stages = {stage.name: stage for stage in METHOD}
    is_changed: dict[str, bool] = {}

    @functools.cache
    def planned_match(stage: str) -> Match:
        """Return the match as the stage's units were planned: only earlier stages leave out."""
        earlier = METHOD[: METHOD.index(stages[stage])]
        return match.without(left_out_cameras(store, match, earlier, usable))

    def check(name: str, key: str) -> bool:
        if name not in is_changed:
            stage, _, unit = name.partition("/")
            try:
                manifest = store.manifest(match.match_id, stage, unit, key)
            except StoreError:  # withdrawn or damaged: the next run reports it
                return is_changed.setdefault(name, False)
            recipe = manifest.recipe
            is_known = stage in stages and unit in stages[stage].units(planned_match(stage))
            sources = stages[stage].sources(planned_match(stage), unit) if is_known else {}
            now = recipe.model_copy(update={"sources": recipe.sources | sources})
            is_changed[name] = recipe_key(now) != recipe_key(recipe) or any(
                check(used, used_key) for used, used_key in recipe.inputs.items()
            )
        return is_changed[name]

    waiting = (unit.unit for unit in latest.waiting if unit.unit in results)
    return frozenset(name for name in waiting if check(name, results[name]))


def _reviews(journal: Journal, latest: RunRecord | None, corrected: frozenset[str]) -> list[Review]:
    results = {} if latest is None else latest.results
    asked = set() if latest is None else {unit.request for unit in latest.waiting}
    found = []
    for request in requests_by_id(journal.questions).values():
        decisions = [
            last_decision(journal.questions, unit, content)
            for unit, content in request.contents.items()
        ]
        is_current = any(results.get(unit) == key for unit, key in request.keys.items())
        is_corrected = not corrected.isdisjoint(request.keys)
        decision, is_asked = decisions[0] if decisions else None, request.id in asked
        found.append(Review(request, decision, is_current, is_asked, is_corrected))
    return found


def warnings_of(match: Match) -> list[str]:
    """Return warnings about unusable entries: damaged ones, and corrections that do not apply."""
    return [
        *match.journal.damage,
        *(
            f"correction {correction.id} no longer applies: {reason}"
            for correction, reason in match.stale
        ),
    ]


def still_waiting(store: Store, match: Match, latest: RunRecord | None) -> list[WaitingUnit]:
    """Return the units that the latest run waits for, without those approved or corrected since."""
    said = match.journal.questions
    verdicts = {each.request: each.verdict for each in said if isinstance(each, ReviewDecision)}
    corrected = corrected_units(store, match, latest)
    return [
        unit
        for unit in (() if latest is None else latest.waiting)
        if verdicts.get(unit.request) != "approve" and unit.unit not in corrected
    ]


def decide(
    store: Store,
    match: Match,
    requests: Sequence[str],
    verdict: Literal["approve", "reject"],
    *,
    who: str,
    why: str,
    edits: Sequence[Edit] = (),
    seen: Mapping[str, str] | None = None,
) -> tuple[list[str], list[Correction]]:
    """Record a verdict and its corrections at once; return decided ids and corrections.

    Without `requests`, the verdict is on all pending ones. `edits` correct the reviewed results;
    `seen` is the state of each review as the reviewer saw it, None = any state. StaleEditError if
    another person decided since the reviewer looked; InputError for an unknown request, no pending
    one, or an edit that does not apply. Nothing is kept then.
    """
    latest = latest_run(store, match.match_id)
    ids: list[str] = []
    corrections: list[Correction] = []
    corrected = corrected_units(store, match, latest)

    def decisions(journal: Journal) -> list[ReviewDecision | Correction]:
        current = {each.request.id: each for each in _reviews(journal, latest, corrected)}
        current = {name: each for name, each in current.items() if each.is_current}
        waiting = [name for name, each in current.items() if each.state == "waits"]
        ids[:] = requests or waiting
        unknown = [name for name in ids if name not in current]
        if unknown or not ids:
            raise InputError(
                f"review {unknown[0]}" if unknown else f"reviews of {match.match_id}",
                expected=f"what the latest run asks about: {', '.join(current) or '(nothing)'}",
                found="no such question" if unknown else "nothing that waits",
                todo=f"List the pending reviews: worldpose review list {match.match_id}.",
            )
        for name in ids:
            if seen is not None and current[name].state != seen.get(name):
                raise _decided_meanwhile(name, current[name], seen.get(name))
        results = {} if latest is None else latest.results
        corrections[:] = new_corrections(
            store, match, journal, edits, who=who, note=why, results=results
        )
        now = datetime.now(UTC)
        said = [
            ReviewDecision(
                match_id=match.match_id,
                request=name,
                verdict=verdict,
                who=who,
                why=why,
                decided_at=now,
            )
            for name in ids
        ]
        return [*said, *corrections]

    say(store, match.match_id, decisions)
    return ids, corrections


def _decided_meanwhile(name: str, review: Review, seen: str | None) -> StaleEditError:
    decision = review.decision
    found = review.state if decision is None else f"{decision.verdict} by {decision.who}"
    error = StaleEditError(
        f"review {name}", expected=f"{seen}, as it was shown", found=found, todo="Look at it again."
    )
    error.difference = {
        "review": name,
        "was": seen,
        "now": review.state,
        "who": None if decision is None else decision.who,
    }
    return error


def correct(
    store: Store, match: Match, edits: Sequence[Edit], *, who: str, why: str
) -> list[Correction]:
    """Record corrections without a verdict; InputError, and none is kept, if one does not apply."""
    latest = latest_run(store, match.match_id)
    results = {} if latest is None else latest.results
    corrections: list[Correction] = []

    def list_corrections(journal: Journal) -> list[Correction]:
        corrections[:] = new_corrections(
            store, match, journal, edits, who=who, note=why, results=results
        )
        return corrections

    say(store, match.match_id, list_corrections)
    return corrections


def withdraw(store: Store, match: Match, corrections: Sequence[str], *, who: str, why: str) -> None:
    """Withdraw corrections by their ids, all or none; InputError if one was never made.

    One that is withdrawn already stays so: a page repeats an undo whose answer it missed.
    """

    def withdrawals(journal: Journal) -> list[Withdrawal]:
        for each in corrections:
            if each not in journal.corrections:
                last = [*journal.standing][-10:]
                raise InputError(
                    f"correction {each}",
                    expected=f"one that stands, such as the last: {', '.join(last) or '(none)'}",
                    found="no such correction",
                    todo="List them with `worldpose review show MATCH`.",
                )
        now = datetime.now(UTC)
        return [
            Withdrawal(match_id=match.match_id, correction=each, who=who, why=why, withdrawn_at=now)
            for each in corrections
            if each in journal.standing
        ]

    say(store, match.match_id, withdrawals)


def origins_of(store: Store, match: Match, record: RunRecord) -> dict[str, Origin]:
    """Return each result's origin by `stage/unit`: automatic, corrected or rejected.

    Corrections that the run refused, or that its results lack, correct none of them.
    """
    made_from: dict[str, tuple[str, ...]] = {}
    rejected = set()
    run = Run(store, record)
    for name in record.results:
        manifest = run.manifest(name)
        made_from[name] = tuple(manifest.recipe.inputs)
        decision = last_decision(match.journal.questions, name, manifest.content)
        if decision is not None and decision.verdict == "reject":
            rejected.add(name)
    refused = objections_of(run)
    applied = (each for each in corrections_in(run, match) if each.id not in refused)
    return unit_origins(made_from, applied, rejected)


def corrections_in(run: Run, match: Match) -> list[Correction]:
    """Return the corrections in force that the results of a run contain, refused or not.

    Names count in every run. Of clicks the recipe has the outcome alone: if it is not that of now,
    or the result is gone, those count that were made before the run.
    """
    stages = {stage.name: stage for stage in METHOD}
    left: dict[str, list[JsonValue]] = {}  # of two that are equal, a result can have one

    @functools.cache
    def sources_of(unit: str) -> Mapping[str, JsonValue] | None:
        place = unit.partition("/")[::2]
        key = run.record.results.get(unit)
        if key is None or not run.store.has(match.match_id, *place, key):
            return None
        return run.manifest(unit).recipe.sources

    @functools.cache
    def has_clicks_of_now(unit: str) -> bool:
        stage, _, camera = unit.partition("/")
        then, now = sources_of(unit) or {}, stages[stage].sources(match, camera)
        names = [name for name in ("clicked", "key_frames") if name in then]
        return bool(names) and all(then[name] == now.get(name) for name in names)

    def is_in(correction: Correction, unit: str) -> bool:
        edit, sources = correction.edit, sources_of(unit)
        is_click = isinstance(edit, MovedPoint | RedrawnMarking)
        if sources is None or is_click:
            is_earlier = correction.made_at <= run.record.started_at
            return is_earlier or (is_click and has_clicks_of_now(unit))
        said = sources.get("edits") or sources.get("identities") or []
        assert isinstance(said, list)  # corrections as JSON
        rest, said_now = left.setdefault(unit, [*said]), edit.model_dump(mode="json")
        if said_now not in rest:
            return False
        rest.remove(said_now)
        return True

    found = []
    for each in match.corrections:
        units = _corrected_by(each.edit, run.record.results)
        if not units or True in {is_in(each, unit) for unit in units}:
            found.append(each)
    return found


def unit_origins(
    made_from: Mapping[str, Collection[str]],
    applied: Iterable[Correction],
    rejected: Collection[str],
) -> dict[str, Origin]:
    """Return the origin of each unit's result, by `stage/unit`.

    A rejection propagates to all units computed from the rejected one; a correction marks only the
    unit with corrected evidence, and units computed from it are automatic. `made_from` has the
    input units of each unit, `applied` the corrections in the results.
    """
    corrected: set[str] = set()
    for correction in applied:
        corrected |= _corrected_by(correction.edit, made_from)
    refused = set(rejected)
    while more := {
        unit for unit, sources in made_from.items() if unit not in refused and refused & {*sources}
    }:
        refused |= more
    return {
        unit: "rejected" if unit in refused else "corrected" if unit in corrected else "automatic"
        for unit in made_from
    }


def _corrected_by(edit: Edit, results: Iterable[str]) -> set[str]:
    """Return the units whose evidence an edit corrects, of a run with these results."""
    if isinstance(edit, MovedPoint | RedrawnMarking):
        stage = "static_calibration" if edit.frame is None else "broadcast_calibration"
        return {f"{stage}/{edit.camera}"}
    if isinstance(edit, TRACK_EDITS):
        return {f"tracking/{edit.clip}"}
    if isinstance(edit, DETECTION_EDITS):
        found = f"detection/{edit.camera}"
        detected = {unit for unit in results if unit == found or unit.startswith(f"{found}.")}
        return detected or {f"ingest/{edit.camera}"}
    return set()


def resume(store: Store, match: Match) -> list[str]:
    """Resume suspended runs of a match; return their names at the server.

    InputError if no Prefect server is named, or a review is pending.
    """
    match_id = match.match_id
    if not has_server():
        raise InputError(
            f"resuming {match_id}",
            expected="PREFECT_API_URL, the server that keeps the suspended run",
            found="none",
            todo=f"Continue a run without a server: worldpose run {match_id}.",
        )
    reviews = reviews_of(store, match, latest_run(store, match_id))
    waiting = [each for each in reviews if each.state == "waits"]
    if waiting:
        raise InputError(
            f"resuming {match_id}",
            expected="a verdict on every pending review",
            found=f"none on {', '.join(review.request.id for review in waiting)}",
            todo="Approve or reject each of them first.",
        )
    from flows.orchestration.suspension import resume_suspended  # late: it imports Prefect

    return resume_suspended(store.url, match_id)
