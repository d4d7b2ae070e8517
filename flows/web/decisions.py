"""Decisions on a page: verdicts, and the continuation of a run."""

from __future__ import annotations

from typing import Any, Literal

from fastapi import APIRouter
from pydantic import Field

from data_contracts.records import Name, Record
from data_contracts.review import Edit
from data_contracts.run import GatePolicy
from flows.review.verdicts import decide, still_waiting
from flows.run_record import latest_run
from flows.web.app_context import PageContext, Person

MAX_EDITS: int = 200
"""Maximum number of edits per request."""


class Verdict(Record):
    """A verdict on pending reviews."""

    reviews: tuple[Name, ...] = Field(min_length=1)
    """Ids of the review requests."""
    verdict: Literal["approve", "reject"]
    """Required: there is no default."""
    why: str = Field(default="", max_length=2000)
    """The person's comment."""
    seen: dict[str, str]
    """Review id to the state that the person saw: another person can have decided in between."""
    go_on: bool = True
    """Continue the run when no review is pending."""


class GivenEdit(Record):
    """One edit of a page."""

    id: Name
    """Created by the page: sent again, it is the same edit."""
    edit: Edit
    """With `was` as the page showed it."""


class Edits(Record):
    """Edits that are kept all or none."""

    edits: tuple[GivenEdit, ...] = Field(min_length=1, max_length=MAX_EDITS)
    """Edits in the order of application."""
    note: str = Field(default="", max_length=2000)
    """The person's comment."""


class GoingOn(Record):
    """Options for continuing a run."""

    gates: GatePolicy | None = None
    """When results need review; None = the default of `worldpose run`."""


def routes(context: PageContext) -> APIRouter:
    """Create the routes of all requests that change the journal or start a run."""
    router = APIRouter(prefix="/api/matches/{match_id}")

    @router.post("/decisions")
    def take_verdict(match_id: str, given: Verdict, who: Person) -> dict[str, Any]:
        match = context.match(match_id)
        latest = latest_run(context.store, match_id)
        why, seen = given.why, given.seen
        decide(context.store, match, given.reviews, given.verdict, who=who, why=why, seen=seen)
        waiting = still_waiting(context.store, context.match(match_id), latest)
        run = context.continuing.go_on(match_id) if given.go_on and not waiting else None
        return {"waiting": len(waiting), "run": run}

    @router.post("/runs")
    def go_on(match_id: str, given: GoingOn) -> dict[str, Any]:
        context.match(match_id)
        return context.continuing.go_on(match_id, given.gates)

    return router
