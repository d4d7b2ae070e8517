"""What people say on a page: verdicts, corrections, and that the run is to go on."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import APIRouter
from pydantic import Field

from data_contracts.records import Name, Record
from data_contracts.review import Edit
from data_contracts.run import GatePolicy
from flows.cli.review_text import correction_json
from flows.corrections import keep_edits
from flows.review import decide, still_waiting, withdraw
from flows.run_record import latest_run
from flows.web.app_context import Desk, Person

EDITS: int = 200
"""Most edits that are kept at once."""


class Verdict(Record):
    """A verdict on what waits."""

    reviews: tuple[Name, ...] = Field(min_length=1)
    """Ids of the questions."""
    verdict: Literal["approve", "reject"]
    """It has no default."""
    why: str = Field(default="", max_length=2000)
    """In the person's words."""
    seen: dict[str, str]
    """Id of each question to its state when the person decided: somebody else may have been
    quicker."""
    go_on: bool = True
    """Let the run go on when nothing waits any more."""


class GivenEdit(Record):
    """One edit of a page."""

    id: Name
    """Made by the page: sent again, it is the same edit."""
    edit: Edit
    """With `was` as the page showed it."""


class Edits(Record):
    """Edits that are kept all or none."""

    edits: tuple[GivenEdit, ...] = Field(min_length=1, max_length=EDITS)
    """In the order they are to be applied."""
    note: str = Field(default="", max_length=2000)
    """In the person's words."""


class Withdrawing(Record):
    """A correction to be taken back."""

    correction: Name
    """Its id."""
    why: str = Field(default="", max_length=2000)
    """In the person's words."""


class GoingOn(Record):
    """How a run is to go on."""

    gates: GatePolicy | None = None
    """When results wait for a person; None = as `worldpose run` takes it."""


def routes(desk: Desk) -> APIRouter:
    """Routes of all that changes the journal or starts a run."""
    router = APIRouter(prefix="/api/matches/{match_id}")

    @router.post("/decisions")
    def take_verdict(match_id: str, given: Verdict, who: Person) -> dict[str, Any]:
        match = desk.match(match_id)
        latest = latest_run(desk.store, match_id)
        why, seen = given.why, given.seen
        decide(desk.store, match, given.reviews, given.verdict, who=who, why=why, seen=seen)
        waiting = still_waiting(desk.match(match_id), latest)
        run = desk.continuing.go_on(match_id) if given.go_on and not waiting else None
        return {"waiting": len(waiting), "run": run}

    @router.post("/corrections")
    def correct(match_id: str, given: Edits, who: Person) -> dict[str, Any]:
        edits = {each.id: each.edit for each in given.edits}
        kept = keep_edits(desk.store, lambda: desk.match(match_id), edits, who=who, note=given.note)
        return {"kept": [correction_json(each) for each in kept]}

    @router.post("/withdrawals")
    def take_back(match_id: str, given: Withdrawing, who: Person) -> dict[str, Any]:
        withdraw(desk.store, desk.match(match_id), given.correction, who=who, why=given.why)
        return {"withdrawn": given.correction}

    @router.post("/runs")
    def go_on(match_id: str, given: GoingOn) -> dict[str, Any]:
        desk.match(match_id)
        return desk.continuing.go_on(match_id, given.gates)

    return router
