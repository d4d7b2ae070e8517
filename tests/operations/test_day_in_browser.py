"""An operator's day in a real browser: no command after `worldpose serve`."""

import json
import zipfile
from pathlib import Path

import pytest
from chromium import IN_BROWSER, drive
from command_line import succeed
from faults.checker import doubled
from service import TOKEN

from flows.run_record import runs_at_work
from worldpose.store.integrity import verify
from worldpose.store.store import Store

pytestmark = [*IN_BROWSER, pytest.mark.timeout(3600)]
SCRIPT = Path(__file__).with_name("day_in_browser.mjs")
SIZE = (1920, 1080)


@pytest.fixture
def recorded(tmp_path):
    """Four videos in a folder, the pitch's file, and where markings are seen in each camera.

    In one camera a click is at the wrong place.
    """
    folder = tmp_path / "recorded"
    few = ("--seed", 5, "--duration", 0.4, "--cameras", 4)
    succeed("simulate", "--scenario", "tiny", *few, "--render", "--out", folder)
    clicks = {
        file.stem: {point["name"]: point["xy"] for point in json.loads(file.read_text())["points"]}
        for file in sorted((folder / "annotations" / "static_calibration").glob("*.json"))
    }
    wrong = json.loads((folder / "reference" / "clicks.json").read_text())
    assert [camera for camera in clicks if wrong[camera]["wrong"]] == ["cam03"]
    return folder, clicks


def test_a_match_of_videos_becomes_results_by_clicks_alone(served, recorded, tmp_path):
    folder, clicks = recorded
    served.options = {"--videos": folder / "videos"}
    served.begin()
    saved = tmp_path / "joints.zip"
    task = {
        "prefect": f"http://127.0.0.1:{served.ports['prefect']}",
        "pages": f"http://127.0.0.1:{served.ports['pages']}",
        "token": TOKEN,
        "match": "derby",
        "videos": len(clicks),
        "pitch": str(folder / "pitch.json"),
        "clicks": clicks,
        "size": SIZE,
        "saved": str(saved),
        "patience": 1200,
    }
    seen = drive(SCRIPT, task, tmp_path, 3500)
    assert {name: value for name, value in seen.items() if "overflow" in name and value} == {}
    # The gate asks about the camera with the wrong click, over images of its video.
    assert (seen["asked"], seen["blank"]) == (["static_calibration/cam03"], 0)
    assert (seen["states"][-1], seen["named"], seen["left"]) == ("complete", 1, 401)
    store = Store.open(str(served.project))
    record = store.run("derby")
    assert (record.state, record.failed, record.waiting) == ("complete", (), ())
    assert record.figures["static_calibration/cam03"]["clicks_wrong"] == 0
    assert (list(verify(store)), list(doubled(store))) == ([], [])
    assert runs_at_work(store, "derby") == ()
    with zipfile.ZipFile(saved) as archive:
        assert archive.testzip() is None
        assert [name for name in archive.namelist() if name.endswith("joints.npz")]
    deployment = served.ask("/deployments/name/reprocess/worldpose-reprocess")
    (schedule,) = deployment["schedules"]
    assert (schedule["active"], schedule["schedule"]["cron"]) == (True, "0 3 * * *")
    # Nothing was started past the service's one way, and nothing was computed twice.
    runs = served.ask("/flow_runs/filter", {"flows": {"name": {"any_": ["match"]}}})
    assert {run["work_pool_name"] for run in runs} == {"worldpose"}
    assert served.end() == 0
