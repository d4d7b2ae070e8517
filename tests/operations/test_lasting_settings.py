"""Settings and schedules of a served project: by every door the same, and after every restart."""

import shutil
from dataclasses import replace

import pytest
from command_line import succeed
from service import Browser, wait_until

from worldpose.body.body_file import load_open_body, save_body
from worldpose.store.store import Store

NIGHT = {"cron": "0 3 * * *", "timezone": "Europe/Vienna"}


def schedules(served):
    found = served.ask("/deployments/name/reprocess/worldpose-reprocess")
    keep = ("id", "slug", "active", "schedule")
    kept = [{name: each[name] for name in keep} for each in found["schedules"]]
    return sorted(kept, key=lambda each: each["id"])


@pytest.mark.slow
@pytest.mark.timeout(3600)
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
    assert found == expected
    assert store.run(match_id).body_folder == str(bodies)
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
    assert len(store.runs(match_id)) == len(found)
    assert served.end() == 0
    told = succeed("reprocess", "--dry-run", "--project", served.project, "--json").json
    assert [each["state"] for each in told["matches"]] == ["untouched"]
