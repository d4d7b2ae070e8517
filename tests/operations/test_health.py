"""Health checks name each fault with its remedy; metrics and the status page show the matches."""

import json
import os
import re
import shutil
import socket
import ssl
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import pytest
from command_line import TINY, worldpose
from page_client import TestClient
from prometheus_client.parser import text_string_to_metric_families
from service import free_ports

from data_contracts.operations import Arrival, MatchSummary, Service, Serving, UnitSummary
from flows.cli import options
from flows.cli.project import status
from flows.cli.serve import serve
from flows.orchestration.prefect_api import PrefectApi
from flows.orchestration.prefect_environment import CLIENT_LOGIN
from flows.orchestration.private_cluster import write_certificate
from flows.overview import Overview
from flows.service import health, layout
from flows.service import serving as supervising
from flows.service.alerts import Alert, AlertDispatcher
from flows.service.health import _check_inbox, _check_servers, at_prefect, check
from flows.service.layout import StateFolder
from flows.service.match_runs import match_runs_of
from flows.service.metrics import ProjectMetrics, exposition, metrics_app
from flows.service.plan import Secrets, ServePlan
from flows.service.status_page import StatusRow, status_html
from flows.web.access import access_for
from flows.web.app import create_app
from flows.web.http_server import require_free_ports
from worldpose.errors import InputError, StoreError
from worldpose.store.store import Store


@pytest.fixture
def state(tmp_path):
    return StateFolder(tmp_path / "operations")


def serving(tmp_path, prefect, **services):
    return Serving(
        project=str(tmp_path),
        inbox=str(tmp_path / "inbox"),
        name="healthy",
        prefect=prefect,
        owns_prefect=False,
        services={"serve": Service(pid=os.getpid()), **services},
        started_at=datetime.now(UTC),
    )


def by_part(findings):
    return {finding.part: finding for finding in findings}


def test_what_was_never_started_or_killed_is_said(state, tmp_path):
    (finding,) = check(state)
    assert (finding.part, finding.is_well) == ("serve", False)
    assert "not started" in finding.state
    state.folder.mkdir()
    with state.only_one("serve", wait=False):
        assert [each.state for each in check(state)] == ["it starts"]
    (state.folder / "serve.lock").unlink()
    state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
    (finding,) = check(state)
    assert "killed" in finding.state
    assert not [*state.folder.glob("*.lock")]  # whoever asks may have no right to write
    # Another process can have its number: the lock alone tells that it serves.
    assert match_runs_of(str(tmp_path)) is None
    with state.only_one("serve", wait=False):
        assert match_runs_of(str(tmp_path)) is not None
    assert "worldpose serve" in finding.remedy


def test_every_part_that_is_not_well_says_how_to_mend_it(server, state, tmp_path, monkeypatch):
    dead = Service(pid=2**22 + 1, address="http://127.0.0.1:9")
    state.write_serving(serving(tmp_path, server, pages=dead))
    monkeypatch.setattr(health, "LOW_DISK_GB", 1e9)
    with state.only_one("serve", wait=False):
        found = by_part(check(state))
        assert {part for part, each in found.items() if each.is_well} == {"serve", "prefect"}
        assert "match" in found["deployments"].state
        assert "worker.log" in found["worker of healthy"].remedy
        assert "pages.log" in found["pages"].remedy
        assert "inbox" in found["inbox"].remedy
        assert "worldpose gc" in found["disk"].remedy
        assert all(each.remedy for each in found.values() if not each.is_well)
        # Another login, and without the server: deployments are unknown.
        with monkeypatch.context() as other:
            other.setenv(CLIENT_LOGIN, "worldpose:wrong")
            assert CLIENT_LOGIN in by_part(check(state))["deployments"].remedy
        state.write_serving(serving(tmp_path, "http://127.0.0.1:9/api"))
        (tmp_path / "inbox").mkdir()
        for name, seen in (("a", "taken"), ("b", "refused"), ("c", "refused")):
            state.write_arrival(Arrival(name=name, state=seen, changed_at=datetime.now(UTC)))
        found = by_part(check(state))
        assert "Start the Prefect server" in found["prefect"].remedy
        assert "began 0 s ago" in found["deployments"].remedy  # it may start yet
        assert "Fix prefect first; if it is well" in found["deployments"].remedy
        inbox = found["inbox"]
        assert (inbox.is_well, inbox.state) == (True, "3 known, 2 refused")


def test_a_moved_project_is_refused_before_its_worker_starts(state, tmp_path, monkeypatch):
    there = {"parameters": {"project": "/before/the/move"}}
    monkeypatch.setattr(PrefectApi, "deployment", lambda self, name: there)
    for name in ("problem_at", "require_login", "_require_free_ports"):
        monkeypatch.setattr(supervising, name, lambda _: "")
    own, inbox = serving(tmp_path, "http://127.0.0.1:9/api"), tmp_path / "inbox"
    about = {"project": own.project, "name": own.name, "prefect": own.prefect}
    plan = ServePlan(**about, inbox=inbox, state=state.folder, owns_prefect=False)
    begin = partial(supervising.serve, plan, Secrets("", "", None), lambda: None, print)
    inbox.touch()  # its folders cannot be made, as for want of permission
    with pytest.raises(StoreError, match=r"run again\. Published results are unchanged"):
        begin()
    inbox.unlink()
    with pytest.raises(InputError, match=r"found that of /before/the/move\. .*--name"):
        begin()
    assert not state.logs.exists()
    found = next(at_prefect(state, own.model_copy(update={"owns_prefect": True})))
    assert (found.is_well, "/before/the/move" in found.state) == (False, True)
    assert f"Move it back, or remove {state.folder}" in found.remedy


def test_pages_are_asked_with_their_own_certificate(state, tmp_path):
    write_certificate(tmp_path)
    own, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    with HTTPServer((HOST, 0), BaseHTTPRequestHandler) as pages:
        tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        tls.load_cert_chain(own, key)
        pages.socket = tls.wrap_socket(pages.socket, server_side=True)
        Thread(target=pages.handle_request, daemon=True).start()
        at = Service(pid=os.getpid(), address=f"https://{HOST}:{pages.server_port}/login")
        served = serving(tmp_path, "http://127.0.0.1:9/api", pages=at)
        served = served.model_copy(update={"certificate": str(own)})
        assert by_part(_check_servers(state, served))["pages"].state.endswith("answers 501")


HOST = "127.0.0.1"
OPTIONS = ("--port", "--metrics-port", "--prefect-port")


@pytest.fixture
def taken():
    with socket.create_server((HOST, 0)) as other:
        yield other.getsockname()[1]


@pytest.mark.parametrize("chosen", [OPTIONS[:1], OPTIONS[1:], OPTIONS])
def test_a_taken_port_is_named_with_the_next_free_one(chosen):
    ports = dict(zip(OPTIONS, free_ports(3), strict=True))
    wanted = {option: (HOST, port) for option, port in ports.items()}
    with ExitStack() as others:
        for option in chosen:
            others.enter_context(socket.create_server((HOST, ports[option])))
        with pytest.raises(InputError) as refusal:
            require_free_ports(wanted)
    said = str(refusal.value)
    assert said.startswith(f"{chosen[0]} {ports[chosen[0]]}: ")
    free = int(said.rsplit(f"with {chosen[0]} ", 1)[1].partition(",")[0])
    assert free > ports[chosen[0]]
    require_free_ports(wanted)


def test_a_port_for_two_parts_and_a_foreign_address_are_refused():
    (port,) = free_ports(1)
    with pytest.raises(InputError, match=f"--metrics-port {port}: .*another program"):
        require_free_ports({"--port": (HOST, port), "--metrics-port": (HOST, port)})
    with pytest.raises(InputError, match=r"--port 8571: .*192\.0\.2\.1.*--host"):
        require_free_ports({"--port": ("192.0.2.1", 8571)})


def test_a_service_with_a_taken_port_starts_nothing(tmp_path, taken):
    ports = ("--port", free_ports(1)[0], "--metrics-port", taken)
    answer = worldpose("serve", "--project", tmp_path / "p", "--inbox", tmp_path / "in", *ports)
    assert (answer.code, answer.out) == (1, "")
    assert f"--metrics-port {taken}: expected a free port" in answer.err
    assert not list((tmp_path / "p").glob("operations/logs/*.log"))


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("command", "more"), [(serve, {"check": True}), (status, {"match": None})])
def test_a_command_says_that_the_disk_of_its_project_does_not_answer(
    command, more, monkeypatch, tmp_path
):
    monkeypatch.setattr(layout, "DISK_SECONDS", 0.5)
    file = tmp_path / "project.json"
    os.mkfifo(file)  # without a writer
    silent = _check_inbox(StateFolder(tmp_path), SimpleNamespace(inbox=str(file)))
    assert (silent.is_well, silent.state) == (False, "its disk does not answer")
    with pytest.raises(InputError, match=r"project.json: .* no answer within 0.5 s"):
        options.command_of(command)(as_json=True, project=str(tmp_path), **more)
    os.close(os.open(file, os.O_RDWR))


def test_a_folder_that_cannot_be_listed_does_not_answer(monkeypatch, tmp_path):
    assert layout.disk_answers(tmp_path)
    gate = tmp_path / "gate"
    os.mkfifo(gate)  # without a writer
    (tmp_path / "ls").write_text(f"#!/bin/sh\nread line < {gate}\n")
    (tmp_path / "ls").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(layout, "DISK_SECONDS", 0.5)
    assert not layout.disk_answers(tmp_path)
    os.close(os.open(gate, os.O_RDWR))


def test_no_lock_is_made_where_no_disk_is_mounted(state, tmp_path):
    with pytest.raises(FileNotFoundError), state.only_one("versions", wait=True):
        pass
    assert list(tmp_path.iterdir()) == []


INFRA = Path(__file__).parents[2] / "infra"
DASHBOARD = INFRA / "grafana" / "worldpose.json"


def scraped(text):
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.fixture
def served(project_copy):
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
    figures = ProjectMetrics(Overview(Store.create(f"{bucket}/disk")), StateFolder(tmp_path))
    free = scraped(exposition(figures).decode())["worldpose_disk_free_bytes",]
    assert free == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.05)


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
