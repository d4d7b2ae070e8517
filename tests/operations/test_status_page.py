"""The status page shows every match, whatever its state, to those who have logged in."""

import warnings
from datetime import UTC, datetime

import pytest
from command_line import TINY

from data_contracts.operations import Arrival, MatchSummary, UnitSummary
from flows.overview import Overview
from flows.service.layout import StateFolder
from flows.service.status_page import (
    StatusRow,
    status_html,
)
from flows.web.access import access_for
from flows.web.app import create_app
from worldpose.store.store import Store

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the web framework, about its own test client
    from fastapi.testclient import TestClient

TOKEN = "a token of twenty-four.."
OWN = '<script defer src="/status/page.js"></script>'
EVIL = '<script>alert(1)</script>"'


def arrival(**more):
    known = {"name": "m", "state": "taken", "changed_at": datetime.now(UTC)}
    return Arrival(**{**known, **more})


@pytest.fixture
def app(project_copy):
    return create_app(
        str(project_copy), access_for("127.0.0.1", token=TOKEN, names=(), secure=False)
    )


def test_strangers_see_nothing_and_others_the_matches_by_stage(app, project_copy):
    browser = TestClient(app, base_url="http://127.0.0.1:8571")
    for path in ("/status", "/api/status", "/status/page.css", "/status/page.js"):
        assert browser.get(path).status_code == 401
    StateFolder(project_copy / "operations").write_arrival(
        arrival(name=EVIL, state="refused", reason=EVIL)
    )
    assert browser.post("/api/login", json={"who": "Ada", "token": TOKEN}).status_code == 200
    page = browser.get("/status")
    assert "default-src 'none'" in page.headers["content-security-policy"]
    text = page.text
    assert f'<a href="/#/match/{TINY}">' in text
    assert '<span class="done">6/6' in text
    assert f'<a href="/api/matches/{TINY}/results/report">' in text
    assert browser.get(f"/api/matches/{TINY}/results").json()["run"] == "0001"
    assert "core hours, " in text
    assert text.count(OWN) == 1
    assert "<script" not in text.replace(OWN, "")
    assert "&lt;script&gt;" in text
    for path in ("/status/page.css", "/status/page.js"):
        assert browser.get(path).status_code == 200
    answer = browser.get("/api/status").json()
    (match,) = answer["matches"]
    assert (match["match"], match["state"]) == (TINY, "complete")
    cameras = match["stages"]["static_calibration"]
    assert [each["unit"] for each in cameras] == [f"cam0{number}" for number in range(6)]
    assert {each["state"] for each in cameras} == {"done"}
    assert all(each["seconds"] > 0 for each in cameras)
    assert [each["state"] for each in answer["arrivals"]] == ["refused"]


def test_a_match_that_cannot_be_read_hides_no_other(project_copy):
    store = Store.open(str(project_copy))
    damaged = project_copy / "runs" / TINY / "0001.json"
    damaged.write_bytes(damaged.read_bytes().replace(b"complete", b"complote"))
    (match,) = Overview(store).look()
    assert match.state == "unreadable"
    text = status_html([StatusRow(match), StatusRow(MatchSummary(match_id="other"))], [], "")
    assert "other" in text
    assert "0001.json" in text


def test_the_worst_state_of_a_stage_is_what_is_seen():
    units = (
        UnitSummary(unit="cam00", state="done", seconds=1.0),
        UnitSummary(unit="cam01", state="waiting", seconds=2.0, waiting_since=datetime.now(UTC)),
        UnitSummary(unit="cam02", state="failed", why=EVIL),
    )
    match = MatchSummary(match_id="m", stages={"ingest": units[:1], "static_calibration": units})
    run = "http://127.0.0.1:4200/runs/flow-run/1f2e"
    at_work = {"state": "running", "percent": 41.6, "lines": [f"tracking {EVIL}"]}
    text = status_html([StatusRow(match, at_work, run)], [], "http://127.0.0.1:4200")
    assert '<span class="failed">1/3<br>1 failed<br>1 waiting<br>for 0' in text
    assert '<span class="done">1/1' in text
    assert f'href="{run}"' in text and 'href="http://127.0.0.1:4200"' in text
    assert '42 %</span> <progress max="100" value="42">' in text
    assert "results/report" not in text  # no run of it is complete
    assert "<script" not in text.replace(OWN, "")
