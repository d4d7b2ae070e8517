"""What waits for people, what they say of it, and how a run goes on after that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from data_contracts.review import Correction, Edit, Origin, ReviewDecision, ReviewRequest
from data_contracts.run import RunRecord, WaitingUnit
from flows.corrections import new_corrections, withdrawal
from flows.edit_conflicts import StaleEditError
from flows.method import GATES
from flows.prefect_environment import has_server
from flows.run_record import latest_run
from flows.stage import Match
from worldpose.errors import InputError
from worldpose.review import Journal, decision_on, requests_by_id, say, unit_origins
from worldpose.store import Store

State = Literal["waits", "approve", "reject", "superseded"]


@dataclass(frozen=True)
class Review:
    """A question, and what was said.

    Attributes:
        request: what a person was asked to look at.
        decision: the last verdict on the very same bytes.
        is_current: is it about what the latest run has.
    """

    request: ReviewRequest
    decision: ReviewDecision | None
    is_current: bool

    @property
    def state(self) -> State:
        """The verdict; without one, whether somebody is waited for."""
        if self.decision is not None:
            return self.decision.verdict
        return "waits" if self.is_current else "superseded"

    @property
    def question(self) -> str:
        """What a person is to decide."""
        gates = {gate.stage: gate.question for gate in GATES}
        return gates.get(self.request.gate, "Is it good enough to be built upon?")


def reviews_of(match: Match, latest: RunRecord | None) -> list[Review]:
    """All questions about a match, first to last.

    Args:
        match: with its journal.
        latest: its latest run.
    """
    return _reviews(match.journal, latest)


def _reviews(journal: Journal, latest: RunRecord | None) -> list[Review]:
    results = {} if latest is None else latest.results
    found = []
    for request in requests_by_id(journal.questions).values():
        decisions = [decision_on(journal.questions, *each) for each in request.contents.items()]
        is_current = any(results.get(unit) == key for unit, key in request.keys.items())
        found.append(Review(request, decisions[0] if decisions else None, is_current))
    return found


def warnings_of(match: Match) -> list[str]:
    """What people said that cannot be heeded: damaged entries, corrections that do not apply."""
    return [
        *match.journal.damage,
        *(
            f"correction {correction.id} no longer applies: {reason}"
            for correction, reason in match.stale
        ),
    ]


def still_waiting(match: Match, latest: RunRecord | None) -> list[WaitingUnit]:
    """What the latest run waits for, without what was approved since."""
    said = match.journal.questions
    decisions = [each for each in said if isinstance(each, ReviewDecision)]
    verdicts = {decision.request: decision.verdict for decision in decisions}
    waiting = () if latest is None else latest.waiting
    return [unit for unit in waiting if verdicts.get(unit.request) != "approve"]


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
    """Keep a verdict and its corrections, all at once; gives the ids decided and the corrections.

    Args:
        store: where the journal lies.
        match: as it was opened.
        requests: ids of the questions; none = all that wait.
        verdict: the verdict on each.
        who: the person.
        why: in the person's words.
        edits: what is wrong in what was looked at.
        seen: id of each question to the state that the person saw; None = whatever it is.

    Raises:
        StaleEditError: somebody else decided since the person looked.
        InputError: no such question, nothing waits, or an edit does not apply; nothing is kept.
    """
    latest = latest_run(store, match.match_id)
    ids: list[str] = []
    corrections: list[Correction] = []

    def decisions(journal: Journal) -> list[ReviewDecision | Correction]:
        current = {each.request.id: each for each in _reviews(journal, latest) if each.is_current}
        waiting = [name for name, each in current.items() if each.state == "waits"]
        ids[:] = requests or waiting
        unknown = [name for name in ids if name not in current]
        if unknown or not ids:
            raise InputError(
                f"review {unknown[0]}" if unknown else f"reviews of {match.match_id}",
                expected=f"what the latest run asks about: {', '.join(current) or '(nothing)'}",
                found="no such question" if unknown else "nothing that waits",
                todo=f"List them: worldpose review list {match.match_id}.",
            )
        for name in ids:
            if seen is not None and current[name].state != seen.get(name):
                raise _decided_meanwhile(name, current[name], seen.get(name))
        results = {} if latest is None else latest.results
        corrections[:] = new_corrections(match, journal, edits, who=who, note=why, results=results)
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
        f"review {name}",
        expected=f"{seen}, as it was shown",
        found=found,
        todo="Look at it again.",
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
    """Take corrections in without a verdict.

    Raises:
        InputError: an edit does not apply; none is kept.
    """
    latest = latest_run(store, match.match_id)
    results = {} if latest is None else latest.results
    corrections: list[Correction] = []

    def corrected(journal: Journal) -> list[Correction]:
        corrections[:] = new_corrections(match, journal, edits, who=who, note=why, results=results)
        return corrections

    say(store, match.match_id, corrected)
    return corrections


def withdraw(store: Store, match: Match, correction: str, *, who: str, why: str) -> None:
    """Take a correction back.

    Raises:
        InputError: no such correction stands.
    """
    say(
        store,
        match.match_id,
        lambda journal: [withdrawal(journal, correction, who=who, why=why)],
    )


def origins_of(store: Store, match: Match, record: RunRecord) -> dict[str, Origin]:
    """Where each result of a run comes from: automatic, corrected or rejected, by `stage/unit`."""
    made_from: dict[str, tuple[str, ...]] = {}
    rejected = set()
    for name, key in record.results.items():
        stage, _, unit = name.partition("/")
        manifest = store.manifest(match.match_id, stage, unit, key)
        made_from[name] = tuple(manifest.recipe.inputs)
        decision = decision_on(match.journal.questions, name, manifest.content)
        if decision is not None and decision.verdict == "reject":
            rejected.add(name)
    return unit_origins(made_from, match.corrections, rejected)


def resume(store: Store, match: Match) -> list[str]:
    """Let suspended runs of a match go on; gives their names at the server.

    Raises:
        InputError: no Prefect server is named, or somebody still has to decide.
    """
    match_id = match.match_id
    if not has_server():
        raise InputError(
            f"resuming {match_id}",
            expected="PREFECT_API_URL, the server that keeps the suspended run",
            found="none",
            todo=f"A run without a server goes on with: worldpose run {match_id}.",
        )
    waiting = [r for r in reviews_of(match, latest_run(store, match_id)) if r.state == "waits"]
    if waiting:
        raise InputError(
            f"resuming {match_id}",
            expected="a verdict on all that waits",
            found=f"none on {', '.join(review.request.id for review in waiting)}",
            todo="Decide first: worldpose review approve, or reject.",
        )
    from flows.suspension import resume_suspended  # late: Prefect takes seconds to import

    return resume_suspended(store.url, match_id)
