"""Runs that pages start go through the deployment: one after another, linked, none twice."""

import random
import shutil
import signal
import time
from datetime import datetime
from functools import partial
from itertools import pairwise

import pytest
from faults.checker import doubled
from service import Browser, wait_until

from flows.registering import register
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.store.integrity import verify
from worldpose.store.store import Store

SMALL = {"duration": 0.2, "cameras": 3, "players": 2, "stills": False, "video": False}


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


def moment(text):
    return datetime.fromisoformat(text.replace("Z", "+00:00"))


def run_from_pages(served, names):
    """Start all matches on their pages, the first of them twice; return Prefect's runs."""
    browser = Browser(served)
    for name in [names[0], *names]:
        answer = browser.ask(f"/api/matches/{name}/runs", {"gates": "never"})
        assert answer["state"] == "running"
    at_work = [browser.ask(f"/api/matches/{name}")["at_work"] for name in names]
    assert all(each["state"] == "running" and each["prefect"] for each in at_work), at_work
    assert "before it" in at_work[-1]["lines"][0]
    ended = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}

    def count_ended():
        return sum(run["state_type"] in ended for run in at_prefect(served))

    for count in range(1, len(names) + 1):  # each in its own time
        wait_until(lambda count=count: count_ended() >= count, served.explain)
    return at_prefect(served)


def require_one_after_another(served, store, names, runs):
    assert sorted(run["parameters"]["match_id"] for run in runs) == sorted(names)
    assert {run["state_name"] for run in runs} == {"Completed"}, served.explain()
    assert {run["work_pool_name"] for run in runs} == {"worldpose"}
    deployment = served.ask("/deployments/name/match/worldpose-match")["id"]
    assert {run["deployment_id"] for run in runs} == {deployment}
    times = sorted((moment(run["start_time"]), moment(run["end_time"])) for run in runs)
    assert all(end <= start for (_, end), (start, _) in pairwise(times))
    for run in runs:
        asked = {"artifacts": {"flow_run_id": {"any_": [run["id"]]}}}
        found = {each["key"]: each for each in served.ask("/artifacts/filter", asked)}
        (link,) = [found[key] for key in found if key.startswith("review-")]
        match_id = run["parameters"]["match_id"]
        assert f":{served.ports['pages']}/#/match/{match_id})" in link["data"]
    for name in names:
        (record,) = [store.run(name, run_id) for run_id in store.runs(name)]
        assert record.state == "complete"
        assert store.unfinished_runs(name) == ()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_matches_started_on_pages_run_one_after_another(served, matches):
    store, names = matches(2)
    served.options = {"--max-concurrent": 1, "--workers": 1}
    served.begin()
    require_one_after_another(served, store, names, run_from_pages(served, names))
    # A second start of a match whose results are current computes and records nothing.
    Browser(served).ask(f"/api/matches/{names[0]}/runs", {"gates": "never"})
    wait_until(
        lambda: sum(run["state_type"] == "COMPLETED" for run in at_prefect(served)) == 3,
        served.explain,
    )
    assert store.runs(names[0]) == ("0001",)
    assert served.end() == 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
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
    assert [store.run(name).state for name in everything] == ["complete"] * 3
    assert list(doubled(store)) == []
    assert list(verify(store)) == []
    assert served.end() == 0
