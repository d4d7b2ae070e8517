"""A second run does nothing, a changed setting what depends on it; a run by the paper's method."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import TINY, succeed, worldpose

from flows.iterate import iterate_match
from flows.registering import open_match
from flows.reprocess import reprocess_matches
from flows.results.best_results import joint_tracks
from flows.running import RunRequest, run_match, settle
from flows.service import deployed
from worldpose import open_run
from worldpose.body.body_file import load_open_body, save_body
from worldpose.store.store import Store

pytestmark = pytest.mark.usefixtures("server")

NO_ORCHESTRATOR = {"PYTHONPATH": str(Path(__file__).with_name("without_orchestrators"))}


def run_json(*arguments, **keywords):
    return succeed("run", *arguments, "--json", **keywords).json


def test_a_finished_match_has_nothing_to_do_and_starts_nothing(tiny, project_copy):
    # Any import of Prefect or Dask ends this process at once.
    answer = run_json(tiny, "--project", project_copy, environment=NO_ORCHESTRATOR)
    assert (answer["executed"], answer["failed"], answer["run"]) == (0, 0, "0001")
    assert Store.open(str(project_copy)).runs(TINY) == ("0001",)


def test_the_guard_against_orchestrators_bites(tiny, tmp_path):
    answer = worldpose("run", tiny, "--project", tmp_path / "new", environment=NO_ORCHESTRATOR)
    assert answer.code != 0
    assert "orchestrator imported" in answer.err


@pytest.fixture(scope="module")
def stricter_run(tiny, tiny_run, tmp_path_factory):
    """That project after a second run that wants three views of a joint; read only."""
    project = tmp_path_factory.mktemp("stricter") / "worldpose-data"
    shutil.copytree(tiny_run, project)
    answer = run_json(tiny, "--project", project, "--set", "triangulation.min_views=3")
    assert (answer["run"], answer["executed"]) == ("0002", 5)
    return project


@pytest.fixture
def stricter_copy(stricter_run, tmp_path):
    """A copy of it, to be changed."""
    return Path(shutil.copytree(stricter_run, tmp_path / "stricter"))


def test_a_triangulation_setting_leaves_tracking_alone(tiny, stricter_copy):
    project = ("--project", stricter_copy)
    units = succeed("diff", f"{TINY}/0001", f"{TINY}/0002", *project, "--json").json["units"]
    units = {unit["unit"]: unit for unit in units}
    changed = {name for name, unit in units.items() if unit["state"] != "same"}
    after = {f"{stage}/clip" for stage in ("retriangulation", "body_fitting", "filtering")}
    assert changed == {"triangulation/clip", "bundle_adjustment/cameras"} | after
    (reason,) = units["triangulation/clip"]["reasons"]
    assert "min_views" in reason and "2" in reason and "3" in reason

    def why(unit, *options):
        return succeed("why", f"{TINY}/{unit}/clip", *options, *project, "--json").json

    assert why("tracking")["state"].startswith("current")
    found = why("triangulation", "--set", "triangulation.min_views=2")
    assert found["state"] == "ready", "run 0001 left this result in the store"
    found = why("triangulation", "--set", "triangulation.min_views=4")
    assert found["state"] == "stale" and any("min_views" in each for each in found["reasons"])
    # Back to the defaults: all results are there, so a new run is recorded without any task.
    back = run_json(tiny, *project, "--default-settings", environment=NO_ORCHESTRATOR)
    assert (back["run"], back["executed"]) == ("0003", 0)
    store = Store.open(str(stricter_copy))
    assert store.run(TINY, "0003").results == store.run(TINY, "0001").results


def test_every_way_to_start_a_run_keeps_the_settings_of_the_latest(tiny, stricter_copy):
    again = succeed("run", tiny, "--project", stricter_copy, environment=NO_ORCHESTRATOR)
    assert "settings: triangulation.min_views=3 (match); see worldpose settings" in again.err
    store = Store.open(str(stricter_copy))
    match, plain = open_match(store, TINY), RunRequest({})
    assert run_match(store, match, plain).run_id == "0002"
    assert iterate_match(store, match, plain, 1).record.run_id == "0002"
    assert deployed.match.fn(str(stricter_copy), TINY, gates="never") == "0002"
    assert [each.state for each in reprocess_matches(store, [TINY], plain)] == ["current"]
    assert store.runs(TINY) == ("0001", "0002")

    # A run that states another setting keeps this one, too, even if it is killed at once.
    settle(store, match, RunRequest({"tracking": {"gate_m": 0.6}}, iterations=2))
    _, request = settle(store, open_match(store, TINY), plain)
    assert request.settings == {"tracking": {"gate_m": 0.6}, "triangulation": {"min_views": 3}}
    assert request.iterations == 2
    for part in ({"until_stage": "tracking"}, {"default_settings": True}):
        _, request = settle(store, open_match(store, TINY), RunRequest({}, **part))
        assert request.iterations == 1
    assert request.settings == {}


def test_a_run_finds_an_installed_body_and_keeps_it(tiny, project_copy, tmp_path):
    folder = tmp_path / "bodies"
    folder.mkdir()

    def install(name):
        save_body(tmp_path / "new.npz", replace(load_open_body(name), name="smpl-neutral"))
        (tmp_path / "new.npz").replace(folder / "smpl-neutral.npz")

    install("open-neutral/2")
    asked = (tiny, "--project", project_copy, "--until", "body_fitting")
    mine = ("--set", "body_fitting.body_model=smpl-neutral")
    refused = worldpose("run", *asked, *mine)
    assert refused.code == 2 and "WORLDPOSE_BODY_FOLDER" in refused.err
    # The worker, another process, was started without this folder.
    answer = run_json(*asked, *mine, "--body-folder", folder)
    assert answer["executed"] == 1
    # The match has kept both: a run in another shell, without the variable, has the same body.
    for where in ({"WORLDPOSE_BODY_FOLDER": str(folder)}, {}):
        again = run_json(*asked, environment={**NO_ORCHESTRATOR, **where})
        assert (again["run"], again["executed"]) == (answer["run"], 0)
    run = open_run(project_copy, TINY)
    assert run["body_fitting/clip"].attrs["body_model"] == "smpl-neutral"
    assert run.bodies("clip") is not None
    install("open-neutral/3")
    asked = ("export", tiny, "--project", project_copy, "--format", "bvh")
    refused = worldpose(*asked, "--out", tmp_path / "out")
    assert refused.code == 1 and "Install that body model again" in refused.err


@pytest.mark.slow
def test_the_first_triangulation_of_a_long_match_skips_frames(tiny, project_copy):
    few = ("--set", "triangulation.max_frames=10", "--until", "bundle_adjustment")
    run_json(tiny, "--project", project_copy, *few)
    run = open_run(str(project_copy), TINY)
    before = open_run(str(project_copy), TINY, "0001")["triangulation/clip"]
    every, placed = before["frame"].values, run["triangulation/clip"]
    np.testing.assert_array_equal(placed["frame"], every[::3])
    np.testing.assert_allclose(placed["joints"], before["joints"][::3], atol=1e-6)
    used = run["bundle_adjustment/cameras"].attrs["used_frames"]
    assert used and set(used) <= set(every[::3].tolist())
    seen = joint_tracks(run, "clip", "triangulation")
    np.testing.assert_array_equal(seen.frames, every)
    assert np.isnan(seen.joints[1]).all() and not seen.views[1].any()
    np.testing.assert_array_equal(seen.joints[::3], placed["joints"])
    # Without a later stage, the skipped frames have the tracker's joints.
    best, tracked = joint_tracks(run, "clip"), run["tracking/clip"]["joints"].values
    np.testing.assert_array_equal(best.joints[1::3], tracked[1::3].astype(np.float64))
    np.testing.assert_array_equal(best.joints[::3], placed["joints"])
    assert best.covariance is not None and np.isnan(best.covariance[1::3]).all()
    assert (best.views[1::3] > 0).any() and not best.views[np.isnan(best.joints[..., 0])].any()
    between = (*few, "--set", "bundle_adjustment.chosen_frames=[0,4]")
    answer = worldpose("run", tiny, "--project", project_copy, *between)
    assert answer.code == 1
    assert "found 4" in answer.err and "triangulation.max_frames=30" in answer.err


def test_an_edited_detection_file_is_another_match(tiny, project_copy, tmp_path):
    edited = shutil.copytree(tiny, tmp_path / "tiny")
    path = next((edited / "detections").glob("*.npz"))
    with np.load(path) as stored:
        arrays = dict(stored)
    arrays["keypoints"] = arrays["keypoints"] + np.float32(1)
    np.savez(path, **arrays)
    answer = worldpose("run", edited, "--project", project_copy)
    assert answer.code == 1
    assert f"detections/{path.name}" in answer.err
    assert "give the changed match a new id" in answer.err


def test_from_and_until_take_what_is_there(tiny, project_copy):
    until = run_json(tiny, "--project", project_copy, "--until", "tracking")
    assert (until["run"], until["executed"]) == ("0001", 0)
    joints = ("--until", "triangulation")
    gated = run_json(tiny, "--project", project_copy, *joints, "--set", "tracking.gate_m=0.4")
    assert (gated["run"], gated["executed"]) == ("0002", 2)
    # From triangulation on, tracking is taken as run 0002 has it, though not by default.
    start = (tiny, "--project", project_copy, "--from", "triangulation")
    answer = run_json(*start, *joints, "--set", "triangulation.min_views=3")
    assert (answer["run"], answer["executed"]) == ("0003", 1)
    store = Store.open(project_copy)
    second, third = store.run(TINY, "0002"), store.run(TINY, "0003")
    assert third.results["tracking/clip"] == second.results["tracking/clip"]
    assert third.settings["tracking"]["gate_m"] == 0.4
    assert third.overrides == {"tracking": {"gate_m": 0.4}, "triangulation": {"min_views": 3}}
    # A setting of a stage that does not run would have no effect, so it is refused.
    refused = worldpose("run", *start, "--set", "tracking.gate_m=0.3")
    assert refused.code == 2


def test_from_needs_a_run_that_came_so_far(tiny, ingested, tmp_path):
    answer = worldpose("run", tiny, "--project", ingested, "--from", "triangulation")
    assert answer.code == 2 and "triangulation/clip" in answer.err
    assert Store.open(ingested).runs(TINY) == ("0001",)
    answer = worldpose("run", tiny, "--project", tmp_path / "new", "--from", "triangulation")
    assert answer.code == 2 and "without --from first" in answer.err


torch = pytest.importorskip("torch")

STAGES = ("static_calibration", "triangulation", "bundle_adjustment", "body_fitting")


@pytest.fixture
def smpl_file(tmp_path):
    """The open body with made-up pose correctives, under SMPL's keys."""
    body, rng = load_open_body(), np.random.default_rng(5)
    parents = np.where(body.parents < 0, 2**32 - 1, body.parents)
    arrays = {
        "v_template": body.template,
        "shapedirs": body.shape_directions,
        "posedirs": 0.002 * rng.normal(size=(6890, 3, 207)),
        "J_regressor": body.joint_regressor,
        "weights": body.weights,
        "kintree_table": np.stack([parents, np.arange(24)]),
        "f": body.faces,
    }
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **arrays)
    return tmp_path / "SMPL_NEUTRAL.npz", arrays


@pytest.mark.slow  # unit/reference_method has its stages
@pytest.mark.timeout(900)
def test_the_paper_s_method_fits_an_installed_body_whose_joints_are_those_of_smplx(
    tiny, tmp_path, smpl_file
):
    file, arrays = smpl_file
    match, project, out = tmp_path / "match", tmp_path / "project", tmp_path / "out"
    shutil.copytree(tiny, match)
    shutil.rmtree(match / "reference")
    bodies = ("--body-folder", tmp_path / "bodies")
    succeed("body", "install", file, *bodies)
    methods = [text for stage in STAGES for text in ("--set", f"{stage}.method=paper")]
    body = ("--set", "body_fitting.body_model=smpl-neutral")
    told = succeed("run", match, "--project", project, *methods, *body, *bodies, "--json").json
    assert told["failed"] == 0
    run = open_run(project, TINY)
    adjusted = run["bundle_adjustment/cameras"]
    assert adjusted["accepted"].values.all()
    assert "no validation" in adjusted.attrs["reasons"][0]
    # Other commands take the folder from the run.
    succeed("export", TINY, "--project", project, "--format", "worldpose", "--out", out)
    truth = ("--prediction", TINY, "--reference", tiny / "reference")
    scores = succeed("evaluate", *truth, "--project", project, "--json").json
    assert scores["g_mpjpe_mm"] < 120.0
    smplx = pytest.importorskip("smplx")
    from smplx.utils import Struct

    arrays["kintree_table"][0, 0] = 0
    with np.load(out / "poses/clip.npz") as poses:
        person, frames = 0, poses["transl"].shape[1]
        names = ("global_orient", "body_pose", "transl")
        given = {name: torch.tensor(poses[name][person]) for name in names}
        given["betas"] = torch.tensor(poses["betas"][[person]]).expand(frames, -1)
    layer = smplx.SMPL("", data_struct=Struct(**arrays), batch_size=frames, dtype=torch.float64)
    with torch.no_grad():
        theirs = layer(**{n: each.to(torch.float64) for n, each in given.items()}).joints.numpy()
    ours = run["body_fitting/clip"]["joints"].values[:, person]
    # Shoulders to ankles of COCO-17 are joints of SMPL; 0.01 mm.
    smpl = [16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8]
    known = np.isfinite(ours[:, 5, 0])
    assert known.any()
    np.testing.assert_allclose(ours[known, 5:], theirs[known][:, smpl], atol=1e-5)
