"""A season of `worldpose serve` in minutes: history, kills, restarts, settings; many units."""

import os
import random
import resource
import shutil
import signal
import subprocess
import time
import urllib.request
from dataclasses import replace
from functools import partial

import psutil
import pytest
import yaml
from command_line import TINY, WORLDPOSE, succeed
from faults.checker import doubled
from many_matches import copy_match, queue_history
from service import Browser, wait_until

from flows.method import METHOD
from flows.registering import register
from flows.run_plan import plan_run
from flows.service.run_queue import find_process
from worldpose.body.body_file import load_open_body, save_body
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.blobs import LocalBlobs
from worldpose.store.integrity import verify
from worldpose.store.run_queue import RunQueue
from worldpose.store.store import Store

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]

SMALL = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}
RESTART_SECONDS = 30.0
MATCHES, FAILED, DAYS = 200, 500, 30.0
"""Of the season that is listed; what it costs per match is the same with ten times as many."""
FIRST_SECONDS, MEGABYTES = 1.0, 500.0
TRIES = 8
"""The machine is shared: the best try counts."""


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
    assert (len(runs_of(names[0])), served.end()) == (count, 0)


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


@pytest.fixture
def matches(served, tmp_path):
    """A function that registers so many small matches in the project before it is served."""

    def make(count, first=0):
        store = Store.create(str(served.project))
        names = []
        for seed in range(first, first + count):
            folder = tmp_path / "matches" / str(seed)
            simulate_match(SCENARIOS["tiny"], seed, folder, MatchOptions(**SMALL))
            match, _ = register(store, folder)
            names.append(match.match_id)
        return store, names

    return make


def at_prefect(served):
    return served.ask("/flow_runs/filter", {"flows": {"name": {"any_": ["match"]}}, "limit": 200})


def test_a_service_killed_at_random_moments_loses_and_doubles_nothing(served, matches, small_match):
    """Its runs began on pages and in the inbox; it is killed three times while they are at work."""
    rng = random.Random(1)
    store, names = matches(2, first=100)
    served.options = {"--max-concurrent": 2, "--workers": 1, "--poll-interval": 5}
    served.begin()
    arriving = served.project / "inbox" / ".arriving"
    shutil.copytree(small_match, arriving)
    arriving.rename(arriving.with_name("arrived"))
    browser = Browser(served)
    for name in names:  # a person starts a run again that was not acknowledged
        start = partial(browser.ask, f"/api/matches/{name}/runs", {"gates": "never"})
        wait_until(start, served.explain)
    for _ in range(3):
        time.sleep(rng.uniform(1.0, 60.0))
        assert served.end(signal.SIGKILL) == 0
        served.begin()

    def has_ended():
        browser = Browser(served)
        for name in store.matches():
            browser.approve_all(name)  # the match in the inbox may have questions
        runs = at_prefect(served)
        states = {run["state_name"] for run in runs}
        assert not states & {"Failed", "Cancelled"}, served.explain()
        return len(runs) >= 3 and states == {"Completed"}

    wait_until(has_ended, served.explain)
    everything = store.matches()
    assert len(everything) == 3 and set(names) < set(everything)
    runs = at_prefect(served)
    assert sorted(run["parameters"]["match_id"] for run in runs) == sorted(everything)
    for run in runs:
        asked = {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}}
        found = [
            each for each in served.ask("/artifacts/filter", asked) if "review-" in each["key"]
        ]
        assert any(f"/#/match/{run['parameters']['match_id']})" in each["data"] for each in found)
    assert [store.run(name).state for name in everything] == ["complete"] * 3
    assert (list(doubled(store)), list(verify(store)), served.end()) == ([], [], 0)


def schedules(served):
    found = served.ask("/deployments/name/reprocess/worldpose-reprocess")
    keep = ("id", "slug", "active", "schedule")
    kept = [{name: each[name] for name in keep} for each in found["schedules"]]
    return sorted(kept, key=lambda each: each["id"])


def test_schedules_and_settings_outlast_two_restarts(served, small_match, tmp_path):
    bodies = tmp_path / "bodies"
    bodies.mkdir()
    save_body(bodies / "smpl-test.npz", replace(load_open_body(), name="smpl-test"))
    stated = ("body_fitting.body_model=smpl-test", "iterations=2", "detection.stride=2")
    stated = (*stated, "tracking.gate_m=0.6", "gates=never", f"body_folder={bodies}")
    options = [text for each in stated for text in ("--set", each)]
    alone = tmp_path / "alone"
    succeed("init", alone)
    succeed("settings", *options, "--project", alone)
    succeed("run", small_match, "--project", alone)
    own = Store.open(alone)
    (match_id,) = own.matches()
    expected = [own.run(match_id, run_id).results for run_id in own.runs(match_id)]
    assert {len(own.runs(match_id))} <= {2, 3}

    succeed("init", served.project)
    succeed("settings", *options, "--project", served.project)
    served.options = {"--workers": 1, "--schedule": "reprocess=0 3 * * * Europe/Vienna"}
    served.begin()
    made = schedules(served)
    assert [each["schedule"]["cron"] for each in made] == ["0 3 * * *"]
    shutil.copytree(small_match, served.project / "inbox" / ".small")
    (served.project / "inbox" / ".small").rename(served.project / "inbox" / "small")
    store = Store.open(served.project)

    def completed(count):
        runs = served.runs(match_id)
        assert not [run for run in runs if run["state_type"] in ("FAILED", "CRASHED")], runs
        return sum(run["state_type"] == "COMPLETED" for run in runs) >= count

    wait_until(lambda: completed(1), served.explain)
    found = [store.run(match_id, run_id).results for run_id in store.runs(match_id)]
    assert (found, store.run(match_id).body_folder) == (expected, str(bodies))
    # A person makes a schedule of their own, in Prefect's page or by its API.
    other = {"interval": 86400.0, "timezone": "Asia/Tokyo"}
    deployment = served.ask("/deployments/name/reprocess/worldpose-reprocess")["id"]
    served.ask(f"/deployments/{deployment}/schedules", [{"schedule": other, "active": True}])
    before = schedules(served)
    assert len(before) == 2
    for options in ({"--workers": 1}, served.options):
        assert served.end() == 0
        served.options = options
        served.begin()
        assert schedules(served) == before
    # By a page and by a schedule's run, nothing is left to compute: the keys are the same.
    Browser(served).ask(f"/api/matches/{match_id}/runs", {"gates": "auto"})
    wait_until(lambda: completed(2), served.explain)
    run = served.ask(f"/deployments/{deployment}/create_flow_run", {"name": "nightly"})
    asked = f"/flow_runs/{run['id']}"
    wait_until(lambda: served.ask(asked)["state_type"] == "COMPLETED", served.explain)
    assert (len(store.runs(match_id)), served.end()) == (len(found), 0)
    told = succeed("reprocess", "--dry-run", "--project", served.project, "--json").json
    assert [each["state"] for each in told["matches"]] == ["untouched"]


CAMERAS = 5000
"""Each is two small units, of `ingest` and of `static_calibration`."""
WORKERS = 2
MOST_OVERHEAD = 0.01
"""Of a small unit, more than in a plain loop of the same functions [s of processor]."""


@pytest.mark.usefixtures("server")
def test_ten_thousand_small_units_are_computed_and_found_again(tmp_path, capsys):
    folder, project = tmp_path / "many", tmp_path / "project"
    many_cameras(folder, CAMERAS)
    asked = ("run", folder, "--project", project, "--until", "static_calibration", "--json")
    own = {"PREFECT_API_URL": ""}  # a server of its own, whose time counts
    units, before = 2 * CAMERAS, processor_seconds()
    done = succeed(*asked, "--workers", WORKERS, timeout=3000, environment=own).json
    each = (processor_seconds() - before) / units
    assert (done["executed"], done["failed"]) == (units, 0)
    began = time.monotonic()
    again = succeed(*asked, timeout=600, environment=own).json
    seconds = time.monotonic() - began
    assert (again["executed"], again["run"]) == (0, done["run"])
    alone = seconds_in_a_loop(folder, tmp_path / "loop")
    with capsys.disabled():
        print(f"\n{units} units in {done['seconds']:.0f} s, again {seconds:.1f} s")
        print(f"of processor a unit: {1e3 * each:.1f} ms, in a plain loop {1e3 * alone:.1f} ms")
    assert seconds < 30.0
    assert each - alone <= MOST_OVERHEAD


def seconds_in_a_loop(folder, project):
    """Return the time per unit in one process that computes and publishes units in turn."""
    from flows.match import task_of  # late: Dask and Prefect take seconds to import

    store = Store.create(str(project))
    match, _ = register(store, folder)
    planned = plan_run(store, match, {}, METHOD[:2])
    tasks = {stage.name: task_of(stage).fn for stage in METHOD[:2]}
    some = [(tasks[each.recipe.stage], each.work(store.url, match, "0001")) for each in planned]
    for compute, work in some[:2] + some[-2:]:
        compute(work)  # loads what it needs
    some = some[2:-2:10]
    began = time.process_time()
    for compute, work in some:
        compute(work)
    return (time.process_time() - began) / len(some)


def processor_seconds():
    """Return the processor time of ended child processes, including their children."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def many_cameras(folder, count):
    """Write a match of `count` copies of one camera and its detections, at two places."""
    small = folder.with_name("small")
    simulate_match(SCENARIOS["tiny"], 0, small, MatchOptions(calibrated=True, **SMALL))
    names = [f"c{number:05d}" for number in range(count)]
    spec = yaml.safe_load((small / "match.yaml").read_text())
    (clip,) = spec["clips"]
    spec |= {
        "match_id": f"many-{count}",
        "cameras": [{**spec["cameras"][0], "id": name} for name in names],
        "clips": [{key: value for key, value in clip.items() if "broadcast" not in key}],
    }
    (folder / "detections").mkdir(parents=True)
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    shutil.copy(small / "pitch.json", folder)
    text = (small / "calibration.toml").read_text()
    # Two places: no calibration has all cameras in one.
    cut = [text.index(f"[cam_{number}]") for number in range(3)]
    blocks = [text[cut[0] : cut[1]], text[cut[1] : cut[2]]]
    cameras = [
        blocks[n % 2].replace(f"cam0{n % 2}", name).replace(f"cam_{n % 2}", f"cam_{n}")
        for n, name in enumerate(names)
    ]
    (folder / "calibration.toml").write_text("".join(cameras))
    for name in names:
        shutil.copy(small / "detections" / "cam00.npz", folder / "detections" / f"{name}.npz")
