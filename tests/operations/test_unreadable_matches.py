"""A match that cannot be read, whatever the cause, is named and hides no other."""

import errno
import os
import re
import shutil
import time
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from threading import Event, active_count
from types import SimpleNamespace

import pytest
import service
from command_line import worldpose
from fastapi import HTTPException
from page_client import HERE, TOKEN, TestClient, browser, log_in, served
from stalled_disk import stalled
from starlette.responses import Response

from data_contracts.operations import MatchSummary, QueuedRun
from flows import patience, reprocess, running
from flows.layers import SETTINGS_LOCK, read_layers
from flows.orchestration.dashboard_login import DashboardLogin
from flows.overview import Overview, read_summary
from flows.registering import open_match, register
from flows.results import best_results
from flows.running import RunRequest
from flows.service import watching
from flows.service.alerts import AlertDispatcher, kept_alerts
from flows.service.layout import StateFolder
from flows.service.plan import ServePlan
from flows.web import app_context, intake
from flows.web.app_context import PageContext
from flows.web.drafts import Drafts
from flows.web.intake import NewDraft
from worldpose.store.run_queue import queue_of
from worldpose.store.runs import alone
from worldpose.store.store import Store

wait_until = partial(service.wait_until, pause=0.05)


@pytest.fixture
def two(small_match, tmp_path):
    """A project of two matches, `first` and `second`, and their folders next to it."""
    store = Store.create(tmp_path / "project")
    for number, name in enumerate(("first", "second")):
        _register(store, small_match, tmp_path / name, number)
    return tmp_path


def _register(store, origin, folder, number):
    shutil.copytree(origin, folder)
    text = (folder / "match.yaml").read_text()
    (folder / "match.yaml").write_text(re.sub("match_id: .*", f"match_id: {folder.name}", text))
    file = folder / "pitch.json"
    file.write_text(file.read_text() + "\n" * number)  # another match has other content
    register(store, folder)


@pytest.fixture
def stale_mount(monkeypatch, two):
    """The first match's folder lies on a mount that has gone stale."""
    stat = os.stat

    def fail(path, *arguments, **keywords):
        if isinstance(path, str | os.PathLike) and os.fspath(path).startswith(str(two / "first")):
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), os.fspath(path))
        return stat(path, *arguments, **keywords)

    monkeypatch.setattr(os, "stat", fail)
    return two


def test_pages_show_the_others_beside_a_stale_mount(stale_mount):
    browser = log_in(served(stale_mount / "project"), "Ada")
    answer = browser.get("/api/matches")
    assert answer.status_code == 200
    first, second = answer.json()["matches"]
    assert "Stale file handle" in first["problem"]
    assert second["problem"] is None
    page = browser.get("/api/matches/first")  # with its results, if it has any
    assert (page.status_code, page.json()["problem"]) == (200, first["problem"])
    assert browser.get("/api/matches/second").status_code == 200
    assert browser.get("/status").status_code == 200


@pytest.fixture
def silent(monkeypatch, two):
    monkeypatch.setattr(patience, "SILENT_SECONDS", 0.5)
    monkeypatch.setattr(patience, "SHORT_SECONDS", 0.2)
    stat, answers, file = os.stat, Event(), two / "first" / "match.yaml"
    text = file.read_bytes()
    file.unlink()
    os.mkfifo(file)  # without a writer

    def wait(path, *arguments, **keywords):
        if isinstance(path, str | os.PathLike) and os.fspath(path).startswith(str(two / "first")):
            answers.wait()
        return stat(path, *arguments, **keywords)

    def answer():
        if not answers.is_set():
            answers.set()
            pipe = os.open(file, os.O_RDWR)
            file.unlink()
            file.write_bytes(text)
            os.close(pipe)

    monkeypatch.setattr(os, "stat", wait)
    yield answer
    answer()


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_requests_that_wait_for_a_silent_disk_leave_the_pages_to_others(silent, two):
    browser = log_in(served(two / "project"), "Ada")

    def problems():
        return [each["problem"] for each in browser.get("/api/matches").json()["matches"]]

    wait_until(lambda: "no answer yet" in (problems()[0] or ""))  # slow at first, as far as known
    assert problems()[1] is None
    for _ in range(50):  # more than the server has threads
        assert "no answer yet" in browser.get("/status").text
        assert browser.get("/api/matches/first").status_code == 503
    context = PageContext(Store.open(two / "project"), None)
    with pytest.raises(HTTPException, match="no answer yet"):
        intake._begin(Drafts(two, (), context.store), None, context, "Ada", NewDraft(match="first"))
    assert browser.get("/api/matches/second").status_code == 200
    silent()
    wait_until(lambda: browser.get("/api/matches/first").status_code == 200)
    assert browser.get("/api/matches").json()["matches"][0]["problem"] is None


@pytest.mark.timeout(120)
def test_a_slow_disk_of_a_match_is_not_called_silent(two, monkeypatch):
    monkeypatch.setattr(patience, "SILENT_SECONDS", 0.3)
    monkeypatch.setattr(patience, "SHORT_SECONDS", 0.3)
    store, stat = Store.open(two / "project"), os.stat
    kept = read_summary(store, "first")

    def wait(path, *arguments, **keywords):
        if isinstance(path, str | os.PathLike) and os.fspath(path).startswith(str(two / "first")):
            time.sleep(0.1)
        return stat(path, *arguments, **keywords)

    monkeypatch.setattr(os, "stat", wait)
    seen = Overview(store)
    for _ in range(3):
        assert seen.read("first") == kept
    assert read_summary(store, "first") == kept  # after the last answer


@pytest.fixture
def short(monkeypatch):
    """Short times for the patience with disks, and the reads of this test alone."""
    monkeypatch.setattr(patience, "SILENT_SECONDS", 0.5)
    monkeypatch.setattr(patience, "SHORT_SECONDS", 0.1)
    monkeypatch.setattr(patience, "LATE", {})


def _answers(number, seconds=0.1):
    def read(known):
        for _ in range(number):
            time.sleep(seconds)
        return "found"

    return read


def test_a_read_that_began_before_a_decision_does_not_answer_after_it(short):
    decided, wait = [], _answers(8)

    def read(known):
        return len(decided), wait(known)

    assert patience.read_in_time("m", 0, read, "first", is_patient=False) == ("first", False)
    decided.append("yes")
    found = patience.read_in_time("m", 1, read, "first", is_patient=True)
    assert found == ((1, "found"), False)


def test_no_more_reads_begin_while_many_are_silent(short, monkeypatch):
    monkeypatch.setattr(patience, "MOST_SILENT", 2)
    never = Event()

    def read(place):
        return patience.read_in_time(place, 0, lambda _: never.wait(), place, is_patient=False)

    wait_until(lambda: read("a") == ("a", True))
    assert read("b")[0] == "b"
    wait_until(lambda: read("b") == ("b", True))
    before = active_count()
    assert read("c") == ("c", False) and active_count() == before
    never.set()
    wait_until(lambda: read("c") == (True, False))


def test_only_the_impatient_wait_for_a_shorter_time_beside_a_silent_disk(short, monkeypatch):
    monkeypatch.setattr(patience, "SILENT_SECONDS", 2.0)
    never = Event()
    dead = patience.read_in_time("dead", 0, lambda _: never.wait(), "first", is_patient=True)
    assert dead == ("first", True)
    assert patience.read_in_time("a", 0, _answers(1, 0.3), "", is_patient=True) == ("found", False)
    begun = time.monotonic()
    assert patience.read_in_time("b", 0, _answers(30), "first", is_patient=False) == (
        "first",
        False,
    )
    assert time.monotonic() - begun < 1.5
    never.set()


def test_a_match_is_opened_without_the_lock_of_all_runs(two, monkeypatch):
    runs, free = app_context.Continuing(Store.open(two / "project")), []
    opened = lambda *_: free.append(not runs._lock.locked()) or "m"  # noqa: E731
    monkeypatch.setattr(app_context, "has_server", lambda: True)
    monkeypatch.setattr(app_context, "open_for_review", opened)
    monkeypatch.setattr(app_context, "resume", lambda _, match: [match, str(runs._lock.locked())])
    assert (runs.go_on("first")["how"], free) == ("resumed m, True", [True])


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_dead_disk_of_many_matches_leaves_reads_to_other_disks(
    two, small_match, short, monkeypatch
):
    monkeypatch.setattr(patience, "MOST_SILENT", 3)
    monkeypatch.setattr(patience, "MOST_OF_DISK", 2, raising=False)
    store, dead = Store.open(two / "project"), [f"dead{n}" for n in range(4)]
    for number, name in enumerate(dead, 2):
        _register(store, small_match, two / "disk" / name, number)
    seen = Overview(store)
    with stalled(two / "disk"):
        for name in dead:
            seen.read(name)
            time.sleep(0.6)
        assert sum(not each.made.done() for each in patience.LATE.values()) == 2
        wait_until(lambda: not seen.read("second").is_unseen)
        assert seen.read(dead[-1]).is_silent
    wait_until(lambda: not (now := seen.read(dead[-1])).is_silent and not now.problem)


@pytest.mark.timeout(120)
def test_a_log_in_says_that_the_disk_of_the_project_does_not_answer(two, monkeypatch):
    monkeypatch.setattr(patience, "SILENT_SECONDS", 0.5)
    app = served(two / "project")
    ada, new, given = log_in(app, "Ada"), browser(app), {"who": "Bo", "token": TOKEN}
    sessions = StateFolder(two / "project" / "operations").ended_sessions
    access = replace(app.state.access, ended=sessions)
    prefect = TestClient(DashboardLogin(Response("of Prefect"), access, "a:b"), base_url=HERE)
    prefect.cookies = ada.cookies
    with stalled(two / "project"):
        for _ in range(3):
            for answer in (new.post("/api/login", json=given), ada.get("/api/matches")):
                assert answer.status_code == 503
                assert "the disk of the project does not answer" in answer.json()["error"]
            assert prefect.get("/api/flows").status_code == 503
        for path in ("/login", "/login/page.js", "/api/health"):
            assert ada.get(path).status_code == 200, path
    assert new.post("/api/login", json=given).status_code == 200
    assert (ada.get("/api/session").status_code, prefect.get("/x").text) == (200, "of Prefect")


def test_results_of_a_match_on_a_silent_disk_are_not_called_current(two, monkeypatch):
    store = Store.open(two / "project")
    seen = MatchSummary(match_id="first", is_silent=True, is_settled=True, problem="no answer yet")
    monkeypatch.setattr(reprocess, "read_summary", lambda *_: seen)
    monkeypatch.setattr(best_results, "read_summary", lambda *_: seen)
    monkeypatch.setattr(best_results, "describe_later", lambda *_: "")
    (found,) = reprocess.reprocess_matches(store, ["first"], RunRequest({}))
    assert (found.state, found.problem) == ("failed", "no answer yet")
    assert best_results.describe_age(store, SimpleNamespace(match_id="first")) == "no answer yet"


def test_no_lock_is_held_while_a_disk_is_asked_for_files_of_settings(two, monkeypatch):
    store, free = Store.open(two / "project"), []

    def ask(*_):
        with alone(store.blobs, SETTINGS_LOCK, wait=False) as is_free:
            free.append(is_free)

    monkeypatch.setattr(running, "_require_usable", ask)
    running.settle(store, open_match(store, "first"), RunRequest({}, iterations=2))
    assert free == [True]
    assert read_layers(store, store.registration("first").spec)[-1].values == {"iterations": 2}


@pytest.mark.timeout(120)
def test_a_silent_disk_of_a_match_is_an_alert_that_names_it(silent, two, monkeypatch):
    state, queue = two / "operations", queue_of(str(two / "project"))
    state.mkdir()
    more = {"prefect": "http://127.0.0.1:9/api", "stall_minutes": 10, "disk_gb": 0.0}
    plan = ServePlan(project=str(two / "project"), inbox=two, state=state, **more)
    dispatcher, seen = AlertDispatcher(plan.state_folder, []), Overview(Store.open(two / "project"))
    now = datetime.now(UTC)
    times = {"asked_at": now, "changed_at": now}
    run = QueuedRun(id="1", flow="match", name="r", match_id="first", flow_run="1", **times)
    queue.take(run.model_copy(update={"state": "failed"}))
    held, hold = [], dispatcher.hold
    monkeypatch.setattr(dispatcher, "hold", lambda *a, **b: (held.append((a, b)), hold(*a, **b)))
    watching._hold_alerts(plan, seen, dispatcher, SimpleNamespace(alerts=[]))()
    # Without a kept summary, nothing says whether a later run succeeded.
    assert held == [(([],), {"unread": {"first"}})]
    watching._watch_steps(plan, dispatcher)
    assert kept_alerts(plan.state_folder) == {}
    read = patience.LATE[place := f"match first of {two / 'project'}"]
    read.moved_at -= 601.0
    watching._watch_steps(plan, dispatcher)
    (alert,) = kept_alerts(plan.state_folder).values()
    assert f"looking at {place}: no progress in 10 min" in alert["text"]
    silent()
    wait_until(read.made.done)
    watching._watch_steps(plan, dispatcher)
    assert kept_alerts(plan.state_folder) == {}


@pytest.mark.parametrize("record", ["runs/first/0001.json", "matches/first.json"])
def test_a_damaged_record_hides_no_other_match(two, record):
    path = two / "project" / record
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes((path.read_bytes() if path.exists() else b"{}")[:200])
    answer = worldpose("status", "--project", two / "project")
    assert answer.code == 0, answer.err
    assert any(line.startswith("second ") for line in answer.out.splitlines())
    (problem,) = [line for line in answer.out.splitlines() if line.startswith("first: ")]
    assert record in problem
    assert "worldpose verify --repair" in problem
    browser = log_in(served(two / "project"), "Ada")
    first, second = browser.get("/api/matches").json()["matches"]
    assert record in first["problem"]
    assert second["problem"] is None
    states = {each.match_id: each.state for each in Overview(Store.open(two / "project")).look()}
    assert states["second"] == "not run"
    assert worldpose("gc", "--project", two / "project").code == 0
    register(Store.open(two / "project"), two / "second")
    stray = two / "project" / "results" / "notes.txt"
    stray.parent.mkdir(exist_ok=True)
    stray.write_text("x")
    answer = worldpose("verify", "--repair", "--project", two / "project")
    assert answer.code == 1
    assert "left: results/notes.txt: is not part of any result; remove it" in answer.err
    stray.unlink()
    assert f"set aside: {record}.damaged" in answer.err
    assert worldpose("verify", "--project", two / "project").code == 0
    answer = worldpose("status", "--project", two / "project")
    assert "damaged" not in answer.out
