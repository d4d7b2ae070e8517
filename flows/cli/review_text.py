"""Output of reviews and corrections, as text and JSON."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Any

from data_contracts.review import (
    AddedDetection,
    Correction,
    DeletedDetection,
    MovedKeypoint,
    MovedPoint,
    RedrawnMarking,
)
from flows.cli.console import line, print_json, print_table
from flows.review.verdicts import Review


def print_list(shown: list[Review]) -> None:
    """Print review requests, each with its state and reasons."""
    if not shown:
        line("nothing waits for review")
    for each in shown:
        request = each.request
        line(f"{request.id}  {each.state}, {request.match_id}, {when(request.created_at)}")
        for reason in request.reasons:
            line(f"  {reason}")


def print_review(shown: Review, as_json: bool) -> None:
    """Print one review request, its verdict, and all metrics."""
    if as_json:
        print_json(review_json(shown))
        return
    request, decision = shown.request, shown.decision
    line(f"{request.id}: {shown.state}")
    line(f"  {shown.question}")
    for reason in request.reasons:
        line(f"  because {reason}")
    if decision is not None:
        line(f"  {decision.verdict} by {decision.who}, {when(decision.decided_at)}")
        line(f"  {decision.why or '(no reason given)'}")
    for unit, key in request.keys.items():
        line(f"  {unit} {key}, run {request.run_id}")
    print_table("figures", ("figure", ">value"), _figures(shown))


def _figures(shown: Review) -> list[tuple[str, str]]:
    return [(name, f"{value:.4g}") for name, value in sorted(shown.request.figures.items())]


def review_json(shown: Review) -> dict[str, Any]:
    """Return one review request as JSON."""
    decision = shown.decision
    return {
        **shown.request.model_dump(mode="json"),
        "state": shown.state,
        "question": shown.question,
        "decision": None if decision is None else decision.model_dump(mode="json"),
    }


def correction_json(correction: Correction) -> dict[str, Any]:
    """Return one correction as JSON."""
    return correction.model_dump(mode="json")


def in_words(correction: Correction) -> str:
    """Describe the change of a correction on one line."""
    edit = correction.edit
    if isinstance(edit, MovedPoint | RedrawnMarking):
        place = edit.camera if edit.frame is None else f"{edit.camera} frame {edit.frame}"
        was, xy = (json.dumps(it) if it else "nothing" for it in (edit.was, edit.xy))
        return f"{edit.marking} in {place}: {was} -> {xy}"
    if isinstance(edit, AddedDetection | MovedKeypoint | DeletedDetection):
        place = f"detection {edit.detection} in {edit.camera} frame {edit.frame}"
        if isinstance(edit, DeletedDetection):
            return f"{place}: taken out"
        if isinstance(edit, AddedDetection):
            return f"{place}: added"
        was, xy = (
            "nothing" if it is None else json.dumps([round(value, 2) for value in it])
            for it in (edit.was, edit.xy)
        )
        return f"{edit.joint} of {place}: {was} -> {xy}"
    return f"{edit.kind} {edit.model_dump_json(exclude={'kind'})}"


def when(moment: datetime) -> str:
    """Format a date and time for people."""
    return f"{moment:%Y-%m-%d %H:%M} UTC"
