"""Reviews and corrections described in text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import datetime
from typing import Any, Final

from data_contracts.review import (
    AddedDetection,
    Correction,
    DeletedDetection,
    MergedTracks,
    MovedKeypoint,
    MovedPoint,
    NamedTrack,
    RedrawnMarking,
    SplitTrack,
)
from flows.review.metric_words import reason_words
from flows.review.verdicts import Review

CALIBRATIONS: Final = ("static_calibration/", "broadcast_calibration/")


def review_json(shown: Review) -> dict[str, Any]:
    """Return one review request as JSON."""
    decision = shown.decision
    return {
        **shown.request.model_dump(mode="json"),
        "state": shown.state,
        "question": shown.question,
        "said": [reason_words(each) for each in shown.request.reasons],
        "consequences": shown.consequences,
        "decision": None if decision is None else decision.model_dump(mode="json"),
    }


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
    if isinstance(edit, MergedTracks):
        return f"person {edit.merged} is person {edit.kept} in {edit.clip}"
    if isinstance(edit, SplitTrack):
        frame = edit.first_frame_of_new
        return f"person {edit.person} in {edit.clip} is another person from frame {frame} on"
    if isinstance(edit, NamedTrack):
        return f"person {edit.person} in {edit.clip} is {edit.name or 'without a name'}"
    return f"{edit.kind} {edit.model_dump_json(exclude={'kind'})}"


def describe_corrections(corrections: Iterable[Correction]) -> list[str]:
    """Return a line for each correction that was made, with its id."""
    return [f"corrected: {in_words(each)} ({each.id})" for each in corrections]


def when(moment: datetime) -> str:
    """Format a date and time for people."""
    return f"{moment:%Y-%m-%d %H:%M} UTC"


def is_first_click(correction: Correction) -> bool:
    """Return whether a click was made before a run calibrated its camera: it corrects nothing."""
    is_click = isinstance(correction.edit, MovedPoint | RedrawnMarking)
    return is_click and not any(name.startswith(CALIBRATIONS) for name in correction.based_on)
