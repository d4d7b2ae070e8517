"""A camera that cannot be calibrated is left out; the match continues with a warning."""

import json
import shutil

import pytest
from command_line import TINY, succeed, worldpose

from flows.left_out import left_out_cameras, left_out_warnings
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import RunPlan, plan_run
from tasks.static_calibration import static_calibration
from worldpose.store.store import Store, open_run

STAGES = {stage.name: stage for stage in METHOD}


def spoil(folder, camera):
    """Leave a camera two clicks, which determine nothing."""
    file = folder / "annotations" / "static_calibration" / f"{camera}.json"
    clicked = json.loads(file.read_text())
    clicked["points"], clicked["drawn"] = clicked["points"][:2], []
    file.write_text(json.dumps(clicked))


@pytest.fixture
def calibrated(tiny, tmp_path):
    """A store, and a match all of whose cameras but cam01 are calibrated."""
    folder = shutil.copytree(tiny, tmp_path / "match")
    spoil(folder, "cam01")
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)
    for unit in plan_run(store, match, {}):
        if unit.recipe.stage == "static_calibration":
            static_calibration.fn(unit.work(store.url, match, "0001"))
    return store, match


def test_later_stages_are_planned_without_a_camera_that_is_left_out(calibrated):
    store, match = calibrated
    every = [camera.id for camera in match.folder.spec.static_cameras]
    left = [camera for camera in every if camera != "cam01"]
    planned = plan_run(store, match, {})
    names = {unit.name for unit in planned}
    assert {f"static_calibration/{camera}" for camera in every} <= names
    assert {f"ingest/{camera}" for camera in every} <= names
    listed = [unit.recipe for unit in planned if "cameras" in unit.recipe.sources]
    assert {recipe.stage for recipe in listed} >= {"tracking", "triangulation", "bundle_adjustment"}
    for recipe in listed:
        assert recipe.sources["cameras"] == left
        assert not [name for name in recipe.inputs if name.endswith("/cam01")]


def test_people_are_not_tracked_with_fewer_than_two_cameras(calibrated):
    store, match = calibrated
    results = {unit.name: unit.key for unit in plan_run(store, match, {})}
    only = match.without([camera.id for camera in match.folder.spec.static_cameras][2:])
    plan = RunPlan(store, only, {}, results=results)
    assert plan.plan_stage(STAGES["tracking"]) == []
    assert plan.lacks_cameras
    assert plan.blocked == ["tracking/clip"]
    left_out = left_out_cameras(store, only, METHOD, results)
    first, second = left_out_warnings(only, left_out, 2)
    assert first.startswith("camera cam01 is left out: annotations/static_calibration/cam01.json")
    assert "1 of 2 static cameras can be used (cam00), and 2 are needed" in second


def test_a_match_with_a_camera_that_cannot_be_calibrated_is_complete_and_warns(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    spoil(folder, "cam01")
    project = tmp_path / "project"
    done = worldpose("run", folder, "--project", project, "--json")
    assert done.code == 0, done.err
    assert list(done.json["left_out"]) == ["cam01"]
    (warning,) = [text for text in done.json["warnings"] if "left out" in text]
    assert warning in " ".join(done.err.split())
    run = open_run(project, TINY)
    assert run.record.state == "complete"
    assert run.record.left_out == done.json["left_out"]
    cameras = run["tracking/clip"]["camera"].values.tolist()
    assert "cam01" not in cameras
    assert run["bundle_adjustment/cameras"]["camera"].values.tolist() == cameras
    assert run["body_fitting/clip"].sizes["person"] > 0

    status = succeed("status", "--project", project, "--json").json
    assert warning in status["matches"][0]["warnings"]
    page = tmp_path / "report.html"
    succeed("report", TINY, "--project", project, "--out", page)
    assert "camera cam01 is left out" in page.read_text()
    truth = ("--prediction", TINY, "--reference", tiny / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    assert scores["coverage"] > 0.9
    assert scores["cameras"]["static"]["ground_error_median_m"] < 0.1
    out = tmp_path / "out"
    succeed("export", TINY, "--project", project, "--format", "worldpose", "--out", out)
    succeed("check", out)
    assert not list(out.rglob("*cam01*"))
    # Run again: nothing is computed, and the warning is not forgotten.
    again = succeed("run", folder, "--project", project, "--json").json
    assert (again["executed"], again["left_out"]) == (0, done.json["left_out"])


def test_a_match_with_one_usable_camera_is_partial_and_gates_ask_first(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    project = tmp_path / "project"
    names = sorted(f.stem for f in (folder / "annotations" / "static_calibration").iterdir())
    for camera in names[1:]:
        spoil(folder, camera)
    asked = worldpose("run", folder, "--project", project, "--gates", "auto", "--json")
    assert asked.code == 3, asked.err
    reasons = {each["unit"]: each["reasons"] for each in asked.json["reviews"]}
    assert "would be left out" in reasons[f"static_calibration/{names[1]}"][0]
    done = worldpose("run", folder, "--project", project, "--gates", "never", "--json")
    assert done.code == 4, done.err
    assert done.json["failed"] == 0
    assert done.json["blocked"] > 0
    assert sorted(done.json["left_out"]) == names[1:]
    assert f"1 of {len(names)} static cameras can be used ({names[0]})" in done.json["warnings"][-1]
