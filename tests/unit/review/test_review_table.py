"""The page about a run says who reviewed what."""

from datetime import UTC, datetime
from types import SimpleNamespace

from data_contracts.review import Correction, MovedPoint, ReviewDecision, ReviewRequest, Withdrawal
from flows.reports.report import review_table

NOW = datetime(2026, 1, 2, 3, 4, tzinfo=UTC)
ASKED = ReviewRequest(
    id="r",
    match_id="m",
    run_id="0001",
    gate="tracking",
    keys={"tracking/clip": "0" * 32},
    contents={"tracking/clip": "1" * 64},
    reasons=("undecided is 1, at most 0 passes",),
    figures={"undecided": 1.0},
    created_at=NOW,
)
MOVED = Correction(
    id="c",
    match_id="m",
    edit=MovedPoint(camera="cam00", marking="corner_left_near", was=(0.0, 0.0), xy=(1.0, 2.0)),
    who="Bob",
    made_at=NOW,
    based_on={"static_calibration/cam00": "0" * 32},
)


def said(*records):
    return review_table(SimpleNamespace(journal=SimpleNamespace(records=records)))


def decision(verdict, why=""):
    return ReviewDecision(
        match_id="m", request="r", verdict=verdict, who="Ada", why=why, decided_at=NOW
    )


def test_verdicts_corrections_and_what_was_taken_back_are_told_in_order():
    taken = Withdrawal(match_id="m", correction="c", who="Eve", why="wrong", withdrawn_at=NOW)
    (table,) = said(ASKED, decision("reject", "swapped"), MOVED, taken, decision("approve"))
    assert [row[1:3] for row in table.rows] == [
        ("Ada", "rejected"),
        ("Bob", "corrected"),
        ("Eve", "took back"),
        ("Ada", "approved"),
    ]
    assert table.rows[0] == ("2026-01-02 03:04 UTC", "Ada", "rejected", "tracking/clip", "swapped")
    assert "corner_left_near in cam00" in table.rows[1][3]
    assert table.rows[2][3] == table.rows[1][3]
