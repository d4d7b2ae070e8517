"""A season of `worldpose serve` in minutes: history, kills, a frozen engine, a lost database."""

import os
import shutil
import signal
import subprocess
import time
import urllib.request

import psutil
import pytest
from command_line import TINY, WORLDPOSE
from many_matches import copy_match, queue_history
from service import Browser, wait_until

from flows.registering import register
from flows.service.run_queue import find_process
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.blobs import LocalBlobs
from worldpose.store.run_queue import RunQueue
from worldpose.store.store import Store

SMALL = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
RESTART_SECONDS = 30.0
MATCHES, FAILED, DAYS = 200, 500, 30.0
"""Of the season that is listed; what it costs per match is the same with ten times as many."""
FIRST_SECONDS, MEGABYTES = 1.0, 500.0
TRIES = 8
"""The machine is shared: the best try counts."""


@pytest.mark.slow  # a service, two starts of it, and the runs of two matches
@pytest.mark.timeout(3600)
def test_a_service_survives_kills_frozen_runs_and_the_loss_of_its_database(
    served, webhook, tmp_path
):
    store, names = Store.create(str(served.project)), []
    for seed in (1, 2):
        simulate_match(SCENARIOS["tiny"], seed, tmp_path / str(seed), MatchOptions(**SMALL))
        names.append(register(store, tmp_path / str(seed))[0].match_id)
    served.options = {"--workers": 1, "--stall-minutes": 1, "--disk-gb": 0}
    served.begin()
    queue = RunQueue(LocalBlobs(served.project))

    def runs_of(match):
        return [run for run in queue.runs() if run.match_id == match]

    def at_work(match, since=0):
        """Return the match's run when a later process than that of a state computes it."""
        found = [it for it in runs_of(match) if it.state == "begun" and it.number > since]
        return next((it for it in found if find_process(it.pid, it.flow_run) is not None), None)

    # A killed run restarts.
    browser = Browser(served)
    browser.ask(f"/api/matches/{names[0]}/runs", {"gates": "never"})
    run = wait_until(lambda: at_work(names[0]), served.explain)
    os.kill(run.pid, signal.SIGKILL)
    began = time.monotonic()
    while not any(it.number > run.number + 1 for it in runs_of(names[0])):
        assert time.monotonic() - began < RESTART_SECONDS, served.explain()
        time.sleep(0.2)

    # A frozen engine is an alert, and the other match is computed.
    run = wait_until(lambda: at_work(names[0], run.number), served.explain)
    os.kill(run.pid, signal.SIGSTOP)
    began = time.monotonic()
    browser.ask(f"/api/matches/{names[1]}/runs", {"gates": "never"})

    def stalls():
        return [it for _, it in webhook.posted if it["alert"] == "run_stalled"]

    (alert,) = wait_until(stalls, served.explain)
    assert alert["match"] == names[0] and "no progress for 1 min" in alert["text"]
    assert "no progress" in served.check().out
    assert "no progress" in browser.ask("/status")

    def are_complete():
        states = {it.match_id: it.state for it in queue.runs() if it.match_id in names}
        assert "failed" not in states.values(), served.explain()
        return set(states.values()) == {"complete"}

    wait_until(are_complete, served.explain)
    assert [store.run(name).state for name in names] == ["complete", "complete"]
    wait_until(lambda: served.check().json["healthy"], served.explain)

    def scans():
        return [it for it in queue.runs("queue/ingest") if it.state == "complete"]

    before = len(scans())
    wait_until(lambda: len(scans()) > before + 1, served.explain)  # on schedule, one by one

    # Prefect's database is lost while a run is due: the run is computed.
    browser.ask(f"/api/matches/{names[0]}/runs", {"gates": "never"})
    assert served.end(signal.SIGKILL) == 0
    count = len(runs_of(names[0]))
    assert count == 2
    shutil.rmtree(served.project / "operations" / "prefect")
    served.begin()
    wait_until(lambda: runs_of(names[0])[-1].state == "complete", served.explain)
    assert len(runs_of(names[0])) == count
    assert served.end() == 0


@pytest.mark.slow  # summaries of all matches are made
@pytest.mark.timeout(3600)
def test_the_lists_of_a_season_are_there_within_a_second(served, project_copy):
    copy_match(project_copy, TINY, MATCHES - 1)
    runs = queue_history(project_copy, FAILED, DAYS)
    served.project = project_copy
    served.options = {"--workers": 1, "--disk-gb": 0, "--poll-interval": 15}
    served.begin()
    browser, times = Browser(served), {}
    wait_until(lambda: not browser.ask("/api/matches")["left"], served.explain)

    def first_byte(path):
        began = time.monotonic()
        with browser.opener.open(urllib.request.Request(browser.base + path)) as answer:
            answer.read(1)
            return time.monotonic() - began

    of_one = f"/api/matches/{TINY}-copy017"
    for path in ("/", "/api/matches", "/api/matches?search=copy017", "/status", of_one):
        times[path] = min(first_byte(path) for _ in range(TRIES))

    def first_line(*arguments):
        began = time.monotonic()
        command = [*WORLDPOSE, *arguments, "--project", str(project_copy)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            seconds = time.monotonic() - began
            process.stdout.read()
        return seconds

    times["status"] = min(first_line("status") for _ in range(TRIES))
    service = psutil.Process(served.process.pid)
    sizes = [it.memory_info().rss / 1e6 for it in (service, *service.children(recursive=True))]
    assert max(times.values()) < FIRST_SECONDS
    assert max(sizes) < MEGABYTES
    kept = RunQueue(LocalBlobs(project_copy)).runs()  # the last of each match, and those of a day
    assert len(kept) < len(runs) / 2
    assert served.end() == 0
