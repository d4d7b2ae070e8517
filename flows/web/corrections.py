"""Corrections of a match in groups: one person at one camera or clip in one session."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Annotated, Any, Final

from fastapi import APIRouter, HTTPException, Query
from pydantic import Field

from data_contracts.records import Count, Name, Record
from data_contracts.review import Correction
from flows.review.corrections import keep_edits
from flows.review.descriptions import correction_json, in_words, is_first_click
from flows.review.verdicts import withdraw
from flows.stage import Match
from flows.web.app_context import PageContext, Person
from flows.web.decisions import Edits

SESSION_GAP: Final = timedelta(minutes=30)
"""A longer pause of a person begins a new session."""
MAX_LISTED: Final = 200
"""Corrections of a group in one response, the last ones first."""


class Withdrawing(Record):
    """A correction to withdraw."""

    correction: Name
    """Its id."""
    why: str = Field(default="", max_length=2000)
    """The person's comment."""


class WithdrawingGroup(Record):
    """A group of corrections to withdraw, all or none."""

    count: Count
    """Corrections of the group that the person saw."""
    why: str = Field(default="", max_length=2000)
    """The person's comment."""


@dataclass
class Group:
    """Corrections of one person at one camera or clip in one session.

    Attributes:
        owner: the camera or clip.
        who: the person.
        is_first: whether all are first clicks: made before a run calibrated the camera, so that
            they correct nothing.
        corrections: each with the reason why it no longer applies; None if it applies.
    """

    owner: str
    who: str
    is_first: bool
    corrections: list[tuple[Correction, str | None]] = field(default_factory=list)

    @property
    def id(self) -> str:
        """The id of its first correction."""
        return self.corrections[0][0].id


def count_corrections(match: Match) -> tuple[int, int]:
    """Return the numbers of corrections in force and of first clicks."""
    first = sum(map(is_first_click, match.corrections))
    return len(match.corrections) - first, first


def group_corrections(match: Match) -> list[Group]:
    """Return all corrections in force in groups, the latest group first."""
    objections = {each.id: why for each, why in match.stale}
    groups: list[Group] = []
    open_groups: dict[tuple[str, str, bool], Group] = {}
    for each in match.journal.standing.values():
        key = (_owner(each), each.who, is_first_click(each))
        group = open_groups.get(key)
        if group is None or each.made_at - group.corrections[-1][0].made_at > SESSION_GAP:
            group = open_groups[key] = Group(key[0], key[1], key[2])
            groups.append(group)
        group.corrections.append((each, objections.get(each.id)))
    return sorted(groups, key=lambda group: group.corrections[-1][0].made_at, reverse=True)


def describe_groups(match: Match) -> list[dict[str, Any]]:
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
        for group in group_corrections(match)
    ]


def routes(context: PageContext) -> APIRouter:
    """Create the routes of corrections: keep, list by group, withdraw one or a whole group."""
    router = APIRouter(prefix="/api/matches/{match_id}")

    @router.post("/corrections")
    def correct(match_id: str, given: Edits, who: Person) -> dict[str, Any]:
        edits = {each.id: each.edit for each in given.edits}
        kept = keep_edits(
            context.store, lambda: context.match(match_id), edits, who=who, note=given.note
        )
        return {"kept": [correction_json(each) for each in kept]}

    @router.get("/corrections/{group}")
    def list_group(
        match_id: str, group: str, skip: Annotated[int, Query(ge=0)] = 0
    ) -> dict[str, Any]:
        found = _find(context.match(match_id), group).corrections[::-1]
        return {
            "corrections": [
                {**correction_json(each), "words": in_words(each), "objection": why}
                for each, why in found[skip : skip + MAX_LISTED]
            ],
            "count": len(found),
        }

    @router.post("/corrections/{group}/withdrawal")
    def take_back_all(
        match_id: str, group: str, given: WithdrawingGroup, who: Person
    ) -> dict[str, Any]:
        match = context.match(match_id)
        found = _find(match, group).corrections
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


def _find(match: Match, group_id: str) -> Group:
    for group in group_corrections(match):
        if group.id == group_id:
            return group
    raise HTTPException(409, "the group is not there any more: look again")


def _owner(correction: Correction) -> str:
    edit = correction.edit
    return str(getattr(edit, "camera", None) or getattr(edit, "clip", ""))
