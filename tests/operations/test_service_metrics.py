"""What Prometheus, the dashboard and the status page show of the matches, and to whom."""

import json
import re
import shutil
import warnings
from datetime import UTC, datetime
from pathlib import Path

import pytest
from command_line import TINY
from prometheus_client.parser import text_string_to_metric_families

from data_contracts.operations import Arrival, MatchSummary, UnitSummary
from flows.overview import Overview
from flows.service.alerts import Alert, AlertDispatcher
from flows.service.layout import StateFolder
from flows.service.metrics import ProjectMetrics, exposition, metrics_app
from flows.service.plan import ServePlan
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

INFRA = Path(__file__).parents[2] / "infra"
DASHBOARD = INFRA / "grafana" / "worldpose.json"


def scraped(text):
    """Samples by name and labels, as Prometheus itself reads them."""
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.fixture
def served(project_copy):
    """A served project, and a function that queries its metrics server."""
    state = StateFolder(project_copy / "operations")
    now = datetime.now(UTC)
    for name, known in (("a", "taken"), ("b", "refused"), ("c", "refused")):
        state.write_arrival(Arrival(name=name, state=known, changed_at=now))
    AlertDispatcher(state, []).hold([Alert("disk_low", "disk_low", "little")])
    plan = ServePlan(
        project=str(project_copy),
        inbox=project_copy / "inbox",
        state=state.folder,
        prefect="http://127.0.0.1:4200/api",
    )
    app = metrics_app(plan, ProjectMetrics(Overview(Store.open(str(project_copy))), state), "token")
    client = TestClient(app, base_url="http://127.0.0.1:8573")

    def ask(path, token="token", **headers):
        headers["authorization"] = f"Bearer {token}".encode()
        return client.get(path, headers=headers)

    return ask


def test_a_scrape_says_what_the_store_says_and_all_that_the_dashboard_asks_for(
    served, project_copy
):
    answer = served("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain")
    found = scraped(answer.text)
    store = Store.open(str(project_copy))
    run = store.run(TINY)
    bodies = run.figures["body_fitting/clip"]["bodies"]
    assert bodies > 0
    assert found["worldpose_poses_total",] == bodies
    assert found["worldpose_matches", ("state", "complete")] == 1
    assert found["worldpose_matches", ("state", "failed")] == 0
    done = ("worldpose_units", ("stage", "static_calibration"), ("state", "done"))
    assert found[done] == 6
    assert found["worldpose_run_seconds", ("match", TINY)] == run.seconds
    offset = (("figure", "offset_rms_m"), ("match", TINY), ("stage", "body_fitting"))
    assert found["worldpose_quality", *offset] == run.figures["body_fitting/clip"]["offset_rms_m"]
    limit = (("figure", "offset_rms_m"), ("stage", "body_fitting"))
    assert found["worldpose_quality_limit", *limit] == 0.03
    files = [
        path for top in ("matches", "results", "runs") for path in project_copy.rglob(f"{top}/**/*")
    ]
    assert found["worldpose_store_bytes",] == sum(p.stat().st_size for p in files if p.is_file())
    assert found["worldpose_arrivals", ("state", "refused")] == 2
    assert found["worldpose_alerts", ("alert", "disk_low")] == 1
    # The dashboard and the rules name existing metrics with existing labels.
    names = {name for name, *_ in found}
    asked = [target["expr"] for panel in panels() for target in panel["targets"]]
    rules = (INFRA / "prometheus" / "alerts.yml").read_text()
    asked += re.findall(r"expr: (.*worldpose_.*)", rules)
    for expression in asked:
        used = set(re.findall(r"worldpose_\w+", expression))
        assert used
        assert used <= names, expression
        labels = {label for name, *pairs in found if name in used for label, _ in pairs}
        braces = re.findall(r"\{([^}]*)\}", expression)
        grouped = re.findall(r"(?:by|on) \(([^)]*)\)", expression)
        wanted = re.findall(r"(\w+)\s*=", " ".join(braces)) + re.findall(r"\w+", " ".join(grouped))
        assert set(wanted) <= labels, expression


def panels():
    return json.loads(DASHBOARD.read_text())["panels"]


def test_metrics_are_for_those_who_name_the_server_and_have_its_token(served):
    assert served("/health").status_code == 200
    for host in ("evil.example", "evil@127.0.0.1"):
        assert served("/metrics", host=host).status_code == 421
    for token in ("", "toke", "tokens", "é"):
        assert served("/metrics", token=token).status_code == 401
        assert served("/health", token=token).status_code == 200


def test_what_is_scraped_again_is_looked_at_anew(project_copy):
    store = Store.open(str(project_copy))
    figures = ProjectMetrics(Overview(store), StateFolder(project_copy / "operations"))
    before = scraped(exposition(figures).decode())
    run = store.run(TINY)
    again = run.model_copy(update={"run_id": store.reserve_run(TINY), "executed": ()})
    at_work = scraped(exposition(figures).decode())
    store.finish_run(again.model_copy(update={"seconds": 1.5}))
    after = scraped(exposition(figures).decode())
    assert before["worldpose_matches", ("state", "complete")] == 1
    assert at_work["worldpose_matches", ("state", "at work")] == 1
    assert after["worldpose_run_seconds", ("match", TINY)] == 1.5
    # A run that computed nothing made no poses.
    assert after["worldpose_poses_total",] == before["worldpose_poses_total",]
    (match,) = Overview(store).look()
    assert {state for states in match.progress.values() for state in states} == {"done"}


def test_a_project_in_object_storage_is_told_of_the_disk_of_its_state(bucket, tmp_path):
    store = Store.create(f"{bucket}/disk")
    found = scraped(exposition(ProjectMetrics(Overview(store), StateFolder(tmp_path))).decode())
    assert found["worldpose_disk_free_bytes",] == pytest.approx(
        shutil.disk_usage(tmp_path).free, rel=0.05
    )


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
    state = StateFolder(project_copy / "operations")
    state.write_arrival(arrival(name=EVIL, state="refused", reason=EVIL))
    told = dict.fromkeys(("alert", "match", "text", "link", "since"), "x") | {"told_by": []}
    state.alerts.write_text(json.dumps({"disk": told, "digest": {**told, "alert": "digest"}}))
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
    assert answer["alerts"] == [told]


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
    waits = StatusRow(match, {"state": "running", "waits": True, "lines": ["1 run is before it."]})
    assert (waits.words, waits.kind) == ("waiting for its turn", "waiting for its turn")
    assert '<span class="state">waiting for its turn</span>' in status_html([waits], [], "")
    assert "<script" not in text.replace(OWN, "")
