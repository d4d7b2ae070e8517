"""The queue of a project, its heartbeats, and the end of runs that make no progress."""

import os
import platform
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from types import SimpleNamespace
from uuid import UUID

import psutil
import pytest
import service
from prefect.client.schemas.objects import FlowRun
from prefect.states import Pending

from data_contracts.operations import Heartbeat, QueuedRun
from flows.orchestration import suspension
from flows.progress import Reporter, reporting_to
from flows.service import recovery, run_process, run_queue, watching
from flows.service.alerts import AlertDispatcher, kept_alerts
from flows.service.health import _check_progress
from flows.service.match_runs import MatchRuns
from flows.service.plan import ServePlan
from flows.service.recovery import Liveness
from flows.service.run_queue import beating, find_process
from worldpose.formats.files import sha256_of_file
from worldpose.store.blobs import LocalBlobs
from worldpose.store.documents import seal
from worldpose.store.integrity import repair, verify
from worldpose.store.run_queue import MAX_KILLS, MAX_SERVICE_DEATHS, RunQueue, queue_of
from worldpose.store.store import Store

wait_until = partial(service.wait_until, pause=0.05)

NOW = datetime.now(UTC)


def a_run(name="m", flow="match", **more):
    given = {"id": f"id-{name}", "flow": flow, "name": f"{name}, 1", "flow_run": f"flow-run-{name}"}
    match = {"match_id": name} if flow == "match" else {}
    return QueuedRun(**{**given, **match, "asked_at": NOW, "changed_at": NOW, **more})


@pytest.fixture
def queue(tmp_path):
    Store.create(str(tmp_path))
    return queue_of(str(tmp_path))


def test_of_two_writers_of_a_state_one_wins_and_all_states_stay(queue, tmp_path):
    run = queue.take(a_run())
    other = RunQueue(LocalBlobs(tmp_path))  # of another process
    assert other.change(run, "cancelled", "by Ada").number == 2
    assert queue.change(run, "begun") is None
    assert (queue.latest(run).state, queue.open_runs()) == ("cancelled", [])
    assert queue.take(a_run()) == queue.latest(run)  # asked for once more after a lost answer
    files = sorted(path.name for path in (tmp_path / "queue" / "match" / "m").iterdir())
    assert files == ["id-m.0001.json", "id-m.0002.json"]
    assert verify(Store.open(str(tmp_path))) == ()


@pytest.mark.parametrize("step", ["before", "read", "take", "begin", "run"])
def test_a_run_that_was_cancelled_stays_so_whatever_its_process_does(queue, monkeypatch, step):
    run, runs = queue.take(a_run()), MatchRuns("", project=queue.blobs.url)
    asked = {"id": UUID(int=1), "flow_id": UUID(int=2), "parameters": {"project": runs.project}}
    there, done, told = FlowRun(**asked, state=Pending()), [], []
    monkeypatch.setattr(MatchRuns, "find", lambda *given: {})
    monkeypatch.setattr(MatchRuns, "set_state", lambda runs, *state: told.append(state))

    def at(name, answer=None):
        done.append(name)
        if name == step and not told:
            assert runs.cancel(run, "by Ada") and not runs.cancel(run, "by Ben")
        return answer

    client = SimpleNamespace(
        read_flow_run=lambda run_id: at("read", there), read_flow_run_states=lambda run_id: [there]
    )
    took, begun = RunQueue.take, RunQueue.begin
    monkeypatch.setattr(RunQueue, "take", lambda *given: at("take", took(*given)))
    monkeypatch.setattr(RunQueue, "begin", lambda *given: at("begin", begun(*given)))
    monkeypatch.setattr(run_process, "get_client", lambda **given: nullcontext(client))
    monkeypatch.setattr(run_process, "queued_run", lambda *given: a_run())
    monkeypatch.setattr(run_process, "run_flow", lambda *given, **more: at("run"))
    at("before")
    with suppress(SystemExit):
        run_process.main("match", UUID(int=1))
    last = queue.latest(run)
    assert (last.state, last.message, queue.open_runs()) == ("cancelled", "by Ada", [])
    assert told == [(last.flow_run, "CANCELLED", "by Ada")]
    assert ("run" in done) is (step in ("begin", "run"))
    now = datetime.now(UTC)
    again = SimpleNamespace(name="Scheduled", is_scheduled=lambda: True, timestamp=now)
    client.read_flow_run_states = lambda run_id: [again]  # a person retries it at Prefect
    run_process.main("match", UUID(int=1))
    assert queue.latest(run).state == "complete"


def test_a_damaged_state_is_found_and_hides_no_other_run(queue, tmp_path, caplog):
    queue.take(a_run("a")), queue.take(a_run("b"))
    file = tmp_path / "queue" / "match" / "a" / "id-a.0001.json"
    file.write_bytes(file.read_bytes()[:-9])
    again = RunQueue(LocalBlobs(tmp_path))
    assert [run.match_id for run in again.runs()] == ["b"]
    assert "verify" in caplog.text
    store = Store.open(str(tmp_path))
    (finding,) = verify(store)
    assert repair(store, [finding]) == ((), ("queue/match/a/id-a.0001.json",))
    assert verify(store) == ()


@pytest.mark.parametrize(
    ("kills", "deaths", "ends"),
    [
        (MAX_KILLS - 1, 0, False),
        (MAX_KILLS, 0, True),
        (MAX_KILLS - 1, MAX_SERVICE_DEATHS, False),
        (0, MAX_SERVICE_DEATHS + MAX_KILLS - 1, False),
        (0, MAX_SERVICE_DEATHS + MAX_KILLS, True),
    ],
)
def test_a_run_has_failed_after_too_many_ends_of_its_own(queue, kills, deaths, ends):
    run = queue.take(a_run())
    for number in range(kills + deaths):
        run = queue.kill(run, "killed", by_service=number >= kills)
    assert (run.state == "failed") is ends


def test_old_ends_are_forgotten_but_the_last_of_each_match(queue, tmp_path):
    for number in range(3):
        run = a_run(id=f"{number}", asked_at=NOW - timedelta(days=90 - number))
        queue.change(queue.take(run), "failed", "dark")
    old = queue.take(a_run("open", asked_at=NOW - timedelta(days=90)))
    queue.forget_ended(timedelta(days=1))
    assert len(queue.runs()) == 4
    queue.forget_ended(timedelta(0))
    assert [run.id for run in queue.runs()] == [old.id, "2"]


def assert_goes_on(queue, run):
    before = queue.beat(run).number
    wait_until(lambda: queue.beat(run).number > before + 1)


def stands_still(queue, run):
    time.sleep(0.3)  # what has begun ends
    before = queue.beat(run).number
    time.sleep(0.5)
    return queue.beat(run).number == before


def test_heartbeats_tell_progress_and_stop_without_it(queue, monkeypatch):
    monkeypatch.setattr(run_queue, "BEAT_SECONDS", 0.05)
    run, reporter = queue.begin(queue.take(a_run()), "flow-run-m"), Reporter()
    ended, waits, works = (threading.Event() for _ in range(3))

    def compute():
        with beating(queue, run), reporting_to(reporter):
            while not waits.is_set():  # as between stages
                sum(range(1000))
                time.sleep(0.01)
            works.wait()  # blocked, and no unit is at work
            reporter.stage_started("tracking", "who is who", units=3, missing=3)
            reporter.unit_done("tracking/a", 1.0, {})
            ended.wait()

    thread = threading.Thread(target=compute)
    thread.start()
    wait_until(lambda: queue.beat(run))
    assert_goes_on(queue, run)
    waits.set()
    assert stands_still(queue, run)
    works.set()
    wait_until(lambda: "2 results of this step left, " in queue.beat(run).doing)
    assert_goes_on(queue, run)
    assert queue.beat(run).share == pytest.approx(1 / 3)
    ended.set()
    thread.join()
    queue.change(run, "complete")
    assert queue.beat(run) is None


def test_bytes_of_a_slow_disk_are_progress_until_it_stops(queue, monkeypatch, tmp_path):
    monkeypatch.setattr(run_queue, "BEAT_SECONDS", 0.05)
    run, disk, is_slow = queue.begin(queue.take(a_run()), "m"), tmp_path / "disk", threading.Event()
    os.mkfifo(disk)

    def register():
        with beating(queue, run), ThreadPoolExecutor(1) as threads:
            list(threads.map(sha256_of_file, [disk]))

    def answer():
        while not is_slow.wait(0.02):
            os.write(written, b"video")

    reader, writer = threading.Thread(target=register), threading.Thread(target=answer)
    reader.start()
    written = os.open(disk, os.O_WRONLY)
    writer.start()
    wait_until(lambda: queue.beat(run))
    assert_goes_on(queue, run)
    is_slow.set()
    writer.join()
    assert stands_still(queue, run)
    os.close(written)
    reader.join()


def test_a_disk_that_lists_names_and_reads_nothing_ends_the_heartbeats(
    queue, monkeypatch, tmp_path
):
    monkeypatch.setattr(run_queue, "BEAT_SECONDS", 0.05)
    (tmp_path / "match").mkdir()
    run, file = queue.begin(queue.take(a_run()), "m"), tmp_path / "match" / "match.yaml"

    def beats_of_work():
        before, end = queue.beat(run), time.monotonic() + 0.6
        while time.monotonic() < end:
            continue
        return queue.beat(run).number - (before.number if before else 0)

    with beating(queue, run, file.parent):  # without the file: that is an answer too
        assert beats_of_work() > 1
        os.mkfifo(file)
        time.sleep(0.3)
        assert beats_of_work() == 0
        pipe = os.open(file, os.O_RDWR)
        file.unlink()
        os.close(pipe)
        assert beats_of_work() > 1


COMPUTE = """
import sys, time
from flows.service import run_queue, watching
from flows.service.alerts import AlertDispatcher, kept_alerts
from worldpose.store.run_queue import queue_of
run_queue.BEAT_SECONDS = 0.1
queue = queue_of(sys.argv[1])
run = queue.begin(queue.runs()[0], sys.argv[2])
with run_queue.beating(queue, run):
    while True:
        time.sleep(0.01)
"""


@pytest.fixture
def plan(tmp_path):
    more = {"prefect": "http://127.0.0.1:9/api", "stall_minutes": 10, "disk_gb": 0.0}
    return ServePlan(project=str(tmp_path), inbox=tmp_path, state=tmp_path / "operations", **more)


def look(liveness, first, last):
    for half in range(round(2 * first), round(2 * last) + 1):
        liveness.look(30.0 * half, 30.0 * half)


def test_a_frozen_run_is_ended_with_its_reason_and_restarts(queue, plan):
    run, liveness = queue.take(a_run()), Liveness(plan)
    process = subprocess.Popen([sys.executable, "-c", COMPUTE, plan.project, run.flow_run])
    try:
        wait_until(lambda: queue.beat(run))
        for minute in (0, 8, 16):  # it makes progress
            time.sleep(0.3)
            look(liveness, minute, minute + 8)
        assert find_process(queue.latest(run).pid, run.flow_run).pid == process.pid
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGSTOP)
        look(liveness, 25, 33)
        liveness.look(60.0 * 60.0, 60.0 * 60.0)  # the machine slept
        look(liveness, 60, 70)
        assert queue.latest(run).state == "begun"
        look(liveness, 70, 70.5)
        process.wait(10)
    finally:
        process.kill()
    run = queue.latest(run)
    assert (run.state, run.kills) == ("killed", 1)
    assert "no progress for 10 min" in run.stalled
    assert liveness.alerts == []  # the queue has it


@pytest.mark.parametrize(
    ("kind", "said", "expected"),
    [("PAUSED", "", "waiting"), ("CANCELLING", "cancelled by Ada", "cancelled")],
)
def test_a_run_that_was_killed_has_the_state_that_prefect_gave_it(
    queue, plan, kind, said, expected
):
    run = queue.change(queue.take(a_run()), "begun", pid=None)
    runs = SimpleNamespace(queue=queue, set_state=lambda *_: None)
    there = {"state_type": kind, "state": {"message": said}}
    assert not recovery._recover(plan, runs, run, there, timedelta(0))
    ended = queue.latest(run)
    assert ended.state == expected and ended.message.startswith(said)


def test_a_process_with_the_number_of_a_run_is_not_taken_for_it(queue):
    begun = queue.change(queue.take(a_run()), "begun", pid=os.getpid(), host=platform.node())
    assert find_process(begun.pid, begun.flow_run) is None
    assert find_process(2**22 + 1, begun.flow_run) is None
    assert psutil.pid_exists(os.getpid())


def test_runs_that_nothing_begins_are_an_alert_while_a_place_is_free(queue, plan, monkeypatch):
    monkeypatch.setattr(Liveness, "_end_silent_worker", lambda self: None)
    liveness = Liveness(plan)
    queue.take(a_run("due"))
    other = queue.change(queue.take(a_run("other")), "begun", host="elsewhere", pid=1)
    for minute in range(0, 40):  # the other one has the only place
        queue.blobs.put("queue/match/other/id-other.beat.json", seal_beat(minute))
        liveness.look(60.0 * minute, 60.0 * minute)
    assert liveness.alerts == []
    queue.change(queue.latest(other), "complete")
    look(liveness, 40, 51)
    (alert,) = liveness.alerts
    assert (alert.alert, "due, 1" in alert.text) == ("run_late", True)


def seal_beat(number):
    return seal(Heartbeat(number=number, share=0.0, doing="", at=NOW))


@pytest.mark.parametrize(("hours", "how"), [(-2, "back by 2.0 h"), (2, "forward by 2.0 h")])
def test_a_step_of_the_clock_is_an_alert_for_a_day(queue, plan, hours, how):
    liveness = Liveness(plan)
    run = queue.change(queue.take(a_run()), "begun", host="elsewhere", pid=1)
    for second in range(0, 3600, 60):  # a clock that is slewed by 500 ppm is well
        queue.blobs.put("queue/match/m/id-m.beat.json", seal_beat(second))
        liveness.look(second, 1e9 + second * 1.0005)
    assert liveness.alerts == []
    wall = 1e9 + 3600.0 * hours
    liveness.look(3600.0, wall + 3600.0)
    (alert,) = liveness.alerts
    assert alert.alert == "clock_stepped" and how in alert.text
    assert queue.latest(run).state == "begun"  # its progress has no time of the machine's clock
    liveness.look(3600.0 + 86399.0, wall + 3600.0 + 86399.0)
    assert liveness.alerts == [alert]
    liveness.look(3600.0 + 86401.0, wall + 3600.0 + 86401.0)
    assert liveness.alerts == []


@pytest.mark.parametrize("hours", [-2, 2])
def test_a_run_that_cannot_begin_is_found_whatever_became_of_the_clock(queue, hours):
    run, now, step = queue.take(a_run()), datetime.now(UTC), timedelta(hours=hours)

    def is_stuck(kind, *, due=None, since=now, has_our_clock=True):
        there = {"state_type": kind, "infrastructure_pid": None}
        there |= {"next_scheduled_start_time": due and due.isoformat()}
        there |= {"state": {"timestamp": since.isoformat()}}
        return recovery._is_stuck(run, there, recovery.STARTING, has_our_clock=has_our_clock)

    assert is_stuck("SCHEDULED", due=now + step) == (hours > 0)  # else the worker takes it now
    assert is_stuck("PENDING", since=now + step)
    # The clock of another machine can be ahead.
    assert is_stuck("PENDING", since=now + step, has_our_clock=False) == (hours < 0)
    assert not is_stuck("PENDING", since=now - timedelta(minutes=1))


def test_a_run_that_ends_while_prefect_answers_is_not_retried(queue):
    run = queue.take(a_run())
    queue.change(run, "begun")
    at = datetime.now(UTC) + timedelta(minutes=1)  # it was scheduled again while it ran

    def answer(*_, **__):
        queue.change(queue.latest(run), "complete")
        there = {"id": run.flow_run, "tags": [], "state_type": "SCHEDULED"}
        return [{**there, "expected_start_time": str(at), "state": {"timestamp": at.isoformat()}}]

    recovery.adopt_due(SimpleNamespace(name="n", queue=queue, runs=answer))
    assert queue.latest(run).state == "complete"


def test_a_step_of_the_watcher_that_does_not_end_is_an_alert(plan, monkeypatch):
    """As a scan of an inbox on a network disk that is gone; copies from a bucket take long."""
    plan.state.mkdir()
    dispatcher, now = AlertDispatcher(plan.state_folder, []), time.monotonic()
    steps = {"looking at the inbox": now - 590.0, watching.BUCKET: now - 9000.0}
    monkeypatch.setattr(watching, "STEPS", steps)
    watching._watch_steps(plan, dispatcher)
    assert kept_alerts(plan.state_folder) == {}
    steps["looking at the inbox"] -= 20.0
    watching._watch_steps(plan, dispatcher)
    (alert,) = kept_alerts(plan.state_folder).values()
    assert "looking at the inbox: no progress in 10 min" in alert["text"]
    spent = iter(range(100))  # a slow disk: the thread goes on after each answer
    monkeypatch.setattr(watching, "CLOCKS", {"looking at the inbox": lambda: next(spent)})
    for _ in range(2):
        watching._watch_steps(plan, dispatcher)
    assert kept_alerts(plan.state_folder) == {}


def test_a_resume_waits_for_a_run_that_is_about_to_be_suspended(monkeypatch, tmp_path):
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    monkeypatch.setattr(suspension, "SUSPENDING", 5.0)
    run = {"id": "1", "name": "m, 1", "deployment_id": "d"}
    run["parameters"] = {"match_id": "m", "project": str(tmp_path)}
    states = iter(["RUNNING", "PAUSED", "PAUSED", "SCHEDULED"])
    answers = iter(
        [
            {"status": "REJECT", "details": {"reason": "Run input schema not found."}},
            {"status": "ACCEPT"},
        ]
    )
    listed = lambda *args, **more: [{**run, "state_type": next(states)}]  # noqa: E731
    monkeypatch.setattr(suspension.PrefectApi, "list_all", listed)
    monkeypatch.setattr(suspension.PrefectApi, "ask", lambda *args: next(answers))
    assert suspension.resume_suspended(str(tmp_path), "m") == ["m, 1"]
    assert next(states) == "SCHEDULED"
    monkeypatch.setattr(suspension.PrefectApi, "list_all", lambda *args, **more: [])
    assert suspension.resume_suspended(str(tmp_path), "m") == []


def test_what_stands_still_is_unhealthy(plan):
    state = plan.state_folder
    state.folder.mkdir()
    kept = '{"told_by": [], "since": "2026-01-01", "match": "", "link": "http://h/status", '
    entries = (
        f'"{kind}": {kept}"alert": "{kind}", "text": "why"}}' for kind in ("quality", "run_late")
    )
    state.alerts.write_text(f"{{{', '.join(entries)}}}")
    (finding,) = _check_progress(state)
    assert (finding.is_well, finding.state) == (False, "why")
