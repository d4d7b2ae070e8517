"""Overview of a project: what waits for review."""

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest
from run_records import run_record

from data_contracts.review import ReviewDecision, ReviewRequest
from data_contracts.run import WaitingUnit
from flows.service import overview
from flows.service.overview import Overview

UNIT = "static_calibration/cam03"
REQUEST = "static_calibration.cam03.1f2e3d4c5b6a"
CONTENT, OTHER = "c" * 64, "d" * 64
ASKED = datetime(2026, 5, 1, 12, tzinfo=UTC)
ENDED = ASKED + timedelta(minutes=5)
WRONG = "clicks_wrong is 1, at most 0 passes"
IN_WORDS = "clicks that contradict the others: 1, limit 0"
FIGURES = {
    "expected_ground_error_median_m": 0.01,
    "expected_ground_error_p95_m": 0.04,
    "clicks_wrong": 1.0,
    "weak": 0.0,
}


def record():
    """A run of one camera whose clicks need a review."""
    return run_record(
        run_id="0002",
        state="waiting",
        results={UNIT: "0" * 32},
        waiting=(WaitingUnit(unit=UNIT, request=REQUEST, reasons=(WRONG,)),),
        started_at=ASKED,
        finished_at=ENDED,
    )


def question(content=CONTENT):
    return ReviewRequest(
        id=REQUEST,
        match_id="m",
        run_id="0002",
        gate="static_calibration",
        keys={UNIT: "0" * 32},
        contents={UNIT: content},
        reasons=(WRONG,),
        figures=FIGURES,
        created_at=ASKED,
    )


def verdict(word):
    return ReviewDecision(match_id="m", request=REQUEST, verdict=word, who="Ada", decided_at=ENDED)


class Told:
    """A fake store of one match: its latest run and its journal."""

    def __init__(self, latest, journal=()):
        self.latest, self.journal = latest, journal

    def matches(self):
        return ("m",)

    def runs(self, match):
        return ("0002",)

    def manifest(self, *place):
        return SimpleNamespace(content=CONTENT, seconds=2.0, figures=FIGURES, files=())

    def unfinished_runs(self, match):
        return ()


@pytest.fixture
def glance(monkeypatch):
    """A function that returns the overview's entry for the match of such a store."""
    monkeypatch.setattr(overview, "latest_run", lambda store, match: store.latest)
    journal = lambda store, match: SimpleNamespace(last=0, questions=store.journal)  # noqa: E731
    monkeypatch.setattr(overview, "read_journal", journal)

    def look(*told):
        (match,) = Overview(Told(*told)).look()
        return match

    return look


@pytest.mark.parametrize(
    ("journal", "state", "objections", "since"),
    [
        ([question()], "waiting", (WRONG,), ASKED),
        ([question(), verdict("reject")], "waiting", (WRONG,), ASKED),
        ([question(), verdict("approve")], "done", (), None),
        ([question(), verdict("approve"), verdict("reject")], "waiting", (WRONG,), ASKED),
        # Somebody approved what was there before.
        ([question(OTHER), verdict("approve")], "waiting", (WRONG,), ASKED),
        ([], "waiting", (WRONG,), ENDED),
    ],
)
def test_a_result_waits_until_it_is_approved_itself(glance, journal, state, objections, since):
    ((stage, unit),) = glance(record(), journal).units
    assert (stage, unit.unit, unit.state) == ("static_calibration", "cam03", state)
    assert (unit.objections, unit.waiting_since) == (objections, since)
    assert unit.why == (IN_WORDS if state == "waiting" else "")
