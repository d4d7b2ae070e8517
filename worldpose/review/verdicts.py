"""Current state of the journal: the last verdict on a result, and the standing corrections."""

from __future__ import annotations

from collections.abc import Iterable

from data_contracts.review import (
    Correction,
    ReviewDecision,
    ReviewRecord,
    ReviewRequest,
    Withdrawal,
)


def requests_by_id(records: Iterable[ReviewRecord]) -> dict[str, ReviewRequest]:
    """Return all review requests by id, first to last."""
    asked = (record for record in records if isinstance(record, ReviewRequest))
    return {request.id: request for request in asked}


def decision_on(records: Iterable[ReviewRecord], unit: str, content: str) -> ReviewDecision | None:
    """Return the last verdict on a result's bytes, None without a decision.

    Args:
        records: records of the journal, in order.
        unit: as `stage/unit`.
        content: digest of the result's files; its key may differ from that at the decision.
    """
    about: set[str] = set()
    last = None
    for record in records:
        if isinstance(record, ReviewRequest) and record.contents.get(unit) == content:
            about.add(record.id)
        elif isinstance(record, ReviewDecision) and record.request in about:
            last = record
    return last


def standing_corrections(records: Iterable[ReviewRecord]) -> tuple[Correction, ...]:
    """Return the corrections in the order they were made, without withdrawn ones."""
    standing: dict[str, Correction] = {}
    for record in records:
        if isinstance(record, Correction):
            standing[record.id] = record
        elif isinstance(record, Withdrawal):
            standing.pop(record.correction, None)
    return tuple(standing.values())
