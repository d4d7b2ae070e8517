"""Decisions and corrections of a match, these in groups of one person, camera and session."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, HTTPException, Query
from pydantic import Field

from data_contracts.records import Count, Name, Record
from data_contracts.review import Correction, Edit
from data_contracts.run import GatePolicy
from flows.layers import merge_general
from flows.review.corrections import keep_edits, objections_now, owner_of
from flows.review.descriptions import in_words, is_first_click
from flows.review.verdicts import decide, still_waiting, withdraw
from flows.run_record import latest_run
from flows.running import RunRequest
from flows.stage import Match
from flows.web.app_context import PageContext, Person
from worldpose.store.store import Store

SESSION_GAP: Final = timedelta(minutes=30)
"""A longer pause of a person begins a new session."""
MAX_LISTED: Final = 200
"""Corrections of a group in one response, the last ones first."""
MAX_EDITS: int = 200
"""Maximum number of edits per request."""
Comment = Annotated[str, Field(max_length=2000)]
"""A person's comment."""


class Verdict(Record):
    """A verdict on pending reviews."""

    reviews: tuple[Name, ...] = Field(min_length=1)
    """Ids of the review requests."""
    verdict: Literal["approve", "reject"]
    """Required: there is no default."""
    why: Comment = ""
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
    note: Comment = ""


class GoingOn(Record):
    """Options for continuing a run."""

    gates: GatePolicy | None = None
    """When results need review if no layer of settings says it; None = auto, or as a run that
    has not come to the end."""


class Withdrawing(Record):
    """A correction to withdraw."""

    correction: Name
    """Its id."""
    why: Comment = ""


class WithdrawingGroup(Record):
    """A group of corrections to withdraw, all or none."""

    count: Count
    """Corrections of the group that the person saw."""
    why: Comment = ""


@dataclass
class Group:
    """Corrections of one person at one camera or clip in one session.

    First clicks were made before a run calibrated the camera, so that they correct nothing. Each
    correction has the reason why it no longer applies, None if it applies.
    """

    owner: str
    who: str
    is_first: bool
    corrections: list[tuple[Correction, str | None]] = field(default_factory=list)

    @property
    def id(self) -> str:
        """The id of its first correction."""
        return self.corrections[0][0].id


def group_corrections(store: Store, match: Match) -> list[Group]:
    """Return all corrections in force in groups, the latest group first."""
    objections = objections_now(store, match, latest_run(store, match.match_id))
    objections |= {each.id: why for each, why in match.stale}
    groups: list[Group] = []
    open_groups: dict[tuple[str, str, bool], Group] = {}
    for each in match.journal.standing.values():
        key = (owner_of(each.edit), each.who, is_first_click(each))
        group = open_groups.get(key)
        if group is None or each.made_at - group.corrections[-1][0].made_at > SESSION_GAP:
            group = open_groups[key] = Group(key[0], key[1], key[2])
            groups.append(group)
        group.corrections.append((each, objections.get(each.id)))
    return sorted(groups, key=lambda group: group.corrections[-1][0].made_at, reverse=True)


def describe_groups(store: Store, match: Match) -> list[dict[str, Any]]:
    """Return a summary of each group for the page of a match."""
    return [
        {
            "id": group.id,
            "owner": group.owner,
            "who": group.who,
            "is_first": group.is_first,
            "count": len(group.corrections),
            "stale": sum(why is not None for _, why in group.corrections),
            "kinds": Counter(each.edit.kind for each, _ in group.corrections),
            "first_at": group.corrections[0][0].made_at,
            "last_at": group.corrections[-1][0].made_at,
        }
        for group in group_corrections(store, match)
    ]


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
        match, latest = context.match(match_id), latest_run(context.store, match_id)
        stated = merge_general(match.layers).gates
        waits = latest is not None and bool(latest.waiting)
        is_kept = waits or RunRequest({}).gate_policy(match, latest) != "never"
        gates = given.gates or (None if is_kept else "auto")
        return context.continuing.go_on(match_id, gates if stated is None else None)

    @router.post("/corrections")
    def correct(match_id: str, given: Edits, who: Person) -> dict[str, Any]:
        edits = {each.id: each.edit for each in given.edits}
        kept = keep_edits(
            context.store, lambda: context.match(match_id), edits, who=who, note=given.note
        )
        return {"kept": [each.model_dump(mode="json") for each in kept]}

    @router.get("/corrections/{group}")
    def list_group(
        match_id: str, group: str, skip: Annotated[int, Query(ge=0)] = 0
    ) -> dict[str, Any]:
        found = _find(context.store, context.match(match_id), group).corrections[::-1]
        return {
            "corrections": [
                {**each.model_dump(mode="json"), "words": in_words(each), "objection": why}
                for each, why in found[skip : skip + MAX_LISTED]
            ],
            "count": len(found),
        }

    @router.post("/corrections/{group}/withdrawal")
    def take_back_all(
        match_id: str, group: str, given: WithdrawingGroup, who: Person
    ) -> dict[str, Any]:
        match = context.match(match_id)
        found = _find(context.store, match, group).corrections
        if len(found) != given.count:
            raise HTTPException(409, f"the group has {len(found)} corrections now: look again")
        ids = [each.id for each, _ in found]
        withdraw(context.store, match, ids, who=who, why=given.why)
        return {"withdrawn": len(ids)}

    @router.post("/withdrawals")
    def take_back(match_id: str, given: Withdrawing, who: Person) -> dict[str, Any]:
        match = context.match(match_id)
        withdraw(context.store, match, [given.correction], who=who, why=given.why)
        return {"withdrawn": given.correction}

    return router


def _find(store: Store, match: Match, group_id: str) -> Group:
    for group in group_corrections(store, match):
        if group.id == group_id:
            return group
    raise HTTPException(409, "the group is not there any more: look again")
