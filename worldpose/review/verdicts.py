"""What the journal says now: the last verdict on a result, and the corrections that stand."""

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
    """All that people were asked, first to last."""
    asked = (record for record in records if isinstance(record, ReviewRequest))
    return {request.id: request for request in asked}


def decision_on(records: Iterable[ReviewRecord], unit: str, content: str) -> ReviewDecision | None:
    """The last verdict on a result's bytes, None where nobody has decided.

    Args:
        records: the journal's, in order.
        unit: as `stage/unit`.
        content: digest of the result's files; its key may be another than when it was decided.
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
    """The corrections in the order they were made, without those that were taken back."""
    standing: dict[str, Correction] = {}
    for record in records:
        if isinstance(record, Correction):
            standing[record.id] = record
        elif isinstance(record, Withdrawal):
            standing.pop(record.correction, None)
    return tuple(standing.values())
