"""The method again and again: what an edit reaches, what is fitted again, which one stands."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from command_line import succeed
from filmed import write_filmed
from run_records import run_record
from stand_ins import publish_stand_in

from data_contracts.review import DeletedDetection
from flows import iterate
from flows.gates import Gatekeeper
from flows.iterate import iterate_match
from flows.match import task_of
from flows.method import METHOD
from flows.registering import open_match, register
from flows.review.verdicts import correct
from flows.run_plan import RunPlan, plan_run
from flows.run_record import RunLog, latest_run
from flows.running import RunRequest
from flows.settings import parse_overrides, selected_stages
from flows.stages.body_fitting import REFITTING
from flows.stages.filtering import REDETECTION
from worldpose.errors import InputError, UsageError
from worldpose.formats.release_cameras import read_camera
from worldpose.store.store import Store, open_run

OTHER = {"tracking": {"min_joints": 6}}
LATER = ("tracking", "triangulation", "bundle_adjustment", "retriangulation", "body_fitting")
"""Stages that from the second iteration on look at what was filtered."""


@pytest.fixture
def clips(tiny, tmp_path):
    """A store, and a folder with two clips."""
    folder = halves(tiny, tmp_path / "match")
    (folder / "calibration.toml").unlink()
    return Store.create(tmp_path / "project"), folder


def keys(store, folder, number, overrides=None):
    """The keys of all units of all iterations to one, by iteration and name."""
    match, _ = register(store, folder)
    return {
        (each, unit.name): unit
        for each in range(1, number + 1)
        for unit in plan_run(store, match, overrides or {}, iteration=each)
    }


def reached(match, number, *starts):
    """Return the stages that depend on `starts`, from the declared inputs alone."""
    found = set()
    for each in range(1, number + 1):
        for stage in (stage for stage in METHOD if stage.first_pass <= each):
            for unit in stage.units(match):
                again = stage.previous_pass_inputs(match, unit) if each > 1 else ()
                later = stage.late_inputs(match, unit) if each > 1 else ()
                sources = {(each, up) for up in (*stage.inputs(match, unit), *later)}
                sources |= {(each - 1, up) for up in again}
                # Without anything of the iteration before in it, a unit is the same one.
                if f"{stage.name}/{unit}" in starts or sources & found:
                    found.add((each, f"{stage.name}/{unit}"))
    return found


def test_later_iterations_are_made_from_the_one_before_and_nothing_else_is_new(clips):
    store, folder = clips
    units = keys(store, folder, 3)
    for (number, name), unit in units.items():
        if number == 1:
            continue
        before = units[number - 1, name]
        stage = name.partition("/")[0]
        assert (unit.key != before.key) == (stage in (*LATER, "filtering")), name
        clip = {f"filtering/{each}" for each in ("first", "second") if each in name}
        wanted = clip or {"filtering/first", "filtering/second"}
        if stage in LATER:
            assert wanted <= unit.recipe.inputs.keys()
            for each in wanted:
                assert unit.recipe.inputs[each] == units[number - 1, each].key
        if stage == "tracking":
            # Cameras that agree with people.
            cameras = "bundle_adjustment/cameras"
            assert unit.recipe.inputs[cameras] == units[number - 1, cameras].key


@pytest.mark.parametrize("edit", ["click", "box", "setting"])
def test_an_edit_recomputes_its_dependency_set_in_every_iteration(clips, edit):
    store, folder = clips
    before = keys(store, folder, 3)
    overrides = {}
    if edit == "click":
        file = sorted((folder / "annotations" / "static_calibration").iterdir())[2]
        content = json.loads(file.read_text())
        content["points"][0]["xy"][1] += 0.5
        file.write_text(json.dumps(content))
        starts = [f"static_calibration/{file.stem}"]
    elif edit == "box":
        match, _ = register(store, folder)
        deleted = DeletedDetection(camera="cam01", frame=5, detection=0)
        correct(store, match, [deleted], who="Ada", why="a shadow")
        starts = ["ingest/cam01"]
    else:
        overrides = {"body_fitting": {"loss_scale": 3.0}}
        starts = ["body_fitting/first", "body_fitting/second"]
    after = keys(store, folder, 3, overrides)
    match, _ = register(store, folder)
    changed = {name for name in after if after[name].key != before[name].key}
    assert changed == reached(match, 3, *starts)
    if edit == "setting":
        assert (1, "retriangulation/first") not in changed
        assert (2, "tracking/first") in changed


def record(number, error, state="complete"):
    figures = {} if error is None else {"held_out_error": error, "held_out_keypoints": 100.0}
    figures = {"filtering/clip": figures}
    return run_record(run_id=f"{number:04}", iteration=number, state=state, figures=figures)


@pytest.fixture
def looped(monkeypatch):
    """The loop over iterations with given errors; what it ran, by number."""

    def loop(errors, most, states=None):
        ran = []

        def run(store, match, request):
            ran.append(request.iteration)
            state = (states or {}).get(request.iteration, "complete")
            return record(request.iteration, errors[request.iteration - 1], state)

        def latest(*_):
            return record(ran[-1], errors[ran[-1] - 1]) if ran else None

        monkeypatch.setattr(iterate, "run_match", run)
        monkeypatch.setattr(iterate, "Gatekeeper", lambda *_: None)
        monkeypatch.setattr(iterate, "plan_ahead", lambda *_: SimpleNamespace(missing=[]))
        monkeypatch.setattr(iterate, "_recorded_run", lambda *_: None)
        monkeypatch.setattr(iterate, "settle", lambda store, *given: given)
        monkeypatch.setattr(iterate, "latest_run", latest)
        request = RunRequest({}, gates="never")
        return iterate_match(None, SimpleNamespace(match_id="m"), request, most), ran

    return loop


@pytest.mark.parametrize(
    ("errors", "ran", "kept"),
    [
        ([0.040, 0.0399, 0.02], [1, 2, 1], 1),  # the first is made the latest run again
        ([0.040, 0.036, 0.034, 0.0341], [1, 2, 3, 4, 3], 3),
    ],
)
def test_the_loop_goes_on_while_it_helps_and_keeps_the_best(looped, errors, ran, kept):
    found, runs = looped(errors, None)
    assert (runs, found.kept.number, found.record.iteration) == (ran, kept, kept)
    assert found.ended == f"iteration {kept + 1} is no better"


def test_a_run_that_waits_or_fails_ends_the_loop_and_is_what_the_loop_says(looped):
    found, ran = looped([0.040, None, 0.03], 3, {2: "waiting"})
    assert (ran, found.record.state, found.kept.number) == ([1, 2], "waiting", 1)


@pytest.mark.parametrize(("most", "ran"), [(None, [1, 2, 1]), (3, [1, 2, 3, 1])])
def test_a_loop_whose_left_out_cameras_cannot_judge_keeps_the_first_and_says_so(looped, most, ran):
    found, runs = looped([None, None, None], most)
    assert (found.kept.number, runs) == (1, ran)
    assert found.ended == "held-out cameras cannot tell which iteration is better"


def test_a_part_of_the_method_has_no_iterations():
    with pytest.raises(UsageError, match="whole method"):
        iterate_match(None, None, RunRequest({}, until_stage="tracking"), 2)


@pytest.mark.slow  # with a server and workers of its own
def test_the_command_runs_two_iterations_on_the_workers_of_one_run(tmp_path):
    short, project = tmp_path / "match", tmp_path / "project"
    succeed("simulate", "--scenario", "tiny", "--duration", 0.3, "--no-stills", "--out", short)
    alone = {"PREFECT_API_URL": ""}  # as a user: with a server and workers of its own
    asked = ("run", short, "--project", project, "--iterations", 2, "--json")
    answer = succeed(*asked, environment=alone)
    assert answer.json["failed"] == 0
    assert answer.err.count("starting Prefect and Dask") == 1
    store = Store.open(str(project))
    (match,) = store.matches()
    first, second = (store.run(match, each["run"]) for each in answer.json["iterations"])
    assert (first.iteration, second.iteration, second.parent) == (1, 2, first.run_id)
    assert {name.partition("/")[0] for name in second.executed} == {*LATER, "filtering"}
    again = succeed(*asked).json
    assert (again["run"], again["executed"]) == (answer.json["run"], 0)
    assert again["kept"] == answer.json["kept"]
    status = succeed("status", "--project", project, "--json").json["matches"][0]["units"]
    assert not status["stale"] and not status["missing"] and not status["ready"]


def test_questions_of_an_earlier_run_are_asked_by_a_new_one(monkeypatch):
    monkeypatch.setattr(iterate, "Gatekeeper", lambda *_: None)
    monkeypatch.setattr(iterate, "plan_ahead", lambda *_: SimpleNamespace(missing=[]))
    monkeypatch.setattr(iterate, "latest_run", lambda *_: record(2, None))
    monkeypatch.setattr(iterate, "run_match", lambda *_: record(3, None, "waiting"))
    match, request = SimpleNamespace(match_id="m"), RunRequest({}, gates="never")
    for recorded, expected in (
        (record(1, None, "waiting"), "0003"),  # nobody can answer them: they are not the latest's
        (record(1, None), "0001"),
        (record(2, None, "waiting"), "0002"),
    ):
        monkeypatch.setattr(iterate, "_recorded_run", lambda *_, found=recorded: found)
        found = iterate._pass(None, match, request, lambda missing: request)
        assert found.record.run_id == expected


PEOPLE = 5
CAMERAS = 4
FRAMES = 10


@pytest.mark.slow
def test_who_was_missed_is_found_again_where_the_bodies_are(server, tmp_path):
    folder, project = tmp_path / "match", tmp_path / "project"
    scenario = ("--scenario", "tiny", "--seed", 2, "--duration", 0.4, "--cameras", CAMERAS)
    succeed("simulate", *scenario, "--render", "--no-stills", "--calibrated", "--out", folder)
    # Of five people, each camera leaves out the one with the lowest score.
    asked = ("run", folder, "--project", project, "--iterations", 2)
    asked += ("--set", "detection.stride=2", "--set", f"detection.max_people={PEOPLE - 1}")
    answer = succeed(*asked, "--json").json
    first, second = (each["run"] for each in answer["iterations"])
    (match,) = Store.open(str(project)).matches()
    before, run = (open_run(str(project), match, each) for each in (first, second))
    units = [name for name in run if name.startswith("redetection/")]
    assert len(units) == CAMERAS
    assert not any(name.startswith("redetection/") for name in before)
    truth = np.load(folder / "reference" / "joints.npz")["joints"]
    sought, found, right = 0, 0, []
    for name in units:
        camera_id = name.partition("/")[2].partition(".")[0]
        detected, again = run[name.replace("redetection", "detection")], run[name]
        for array in ("keypoints", "confidence", "boxes", "score"):
            kept = again[array].values[:, : detected.sizes["detection"]]
            np.testing.assert_array_equal(kept, detected[array].values)
        figures = run.record.figures[name]
        sought, found = sought + figures["sought"], found + figures["found"]
        frame, place = np.nonzero(again["found_again"].values >= 0)
        assert len(frame) == figures["found"]
        assert (place >= detected.sizes["detection"]).all()
        camera = read_camera(folder / "reference" / "cameras" / f"{camera_id}.npz")
        pixels = camera.project(truth.reshape(-1, 3)).reshape(*truth.shape[:3], 2)
        for n, k in zip(frame, place, strict=True):
            away = np.linalg.norm(again["keypoints"].values[n, k] - pixels[n], axis=-1)
            trunk = pixels[n][:, (5, 6)].mean(1) - pixels[n][:, (11, 12)].mean(1)
            reach = 0.2 * np.linalg.norm(trunk, axis=-1)
            seen = np.isfinite(away[0])
            right.append((away < reach[:, None])[:, seen].mean(axis=1).max())
    # One an image is missing; some are half hidden or cut, and not looked for.
    assert sought >= FRAMES * CAMERAS / 4
    assert found >= sought / 2
    assert np.mean(right) > 0.8  # as sure as what detectors find themselves
    views = [(each["tracking/clip"]["detection_index"].values >= 0).sum() for each in (before, run)]
    assert views[1] > views[0]
    assert succeed(*asked, "--json").json["executed"] == 0


def halves(tiny, folder, **people):
    """The match `tiny` with given cameras and two clips, in which people are named."""
    if not folder.exists():
        shutil.copytree(tiny, folder)
        shutil.copy(folder / "reference" / "calibration.toml", folder)
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    spec["match_id"] = "halves"
    spec["roster"] = [{"id": name} for name in ("ann", "bea", "cleo")]
    spec["clips"] = [
        {"id": "first", "frame_count": 15},
        {"id": "second", "first_frame": 15, "frame_count": 15},
    ]
    for clip in spec["clips"]:
        clip["people"] = people.get(clip["id"], {})
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    (folder / "detections" / "clip.npz").unlink(missing_ok=True)
    return folder


def test_a_match_of_given_poses_without_names_is_neither_searched_nor_refitted(tiny, tmp_path):
    store = Store.create(tmp_path / "project")
    match, _ = register(store, tiny)
    assert REFITTING.units(match) == REDETECTION.units(match) == ()
    named = halves(tiny, tmp_path / "match", first={0: "ann"}, second={1: "bea"})
    assert REFITTING.units(register(store, named)[0]) == ()


def test_clips_with_the_same_person_are_fitted_again_with_each_others_shapes(tiny, tmp_path):
    folder = halves(tiny, tmp_path / "match", first={0: "ann", 2: "bea"}, second={1: "ann"})
    match, _ = register(Store.create(tmp_path / "project"), folder)
    assert REFITTING.units(match) == ("first", "second")
    assert "body_fitting/second" in REFITTING.inputs(match, "first")
    assert REFITTING.sources(match, "first")["people"] == {
        "first": {"0": "ann"},  # a name that no other clip has changes no shape
        "second": {"1": "ann"},
    }
    # Only namesakes of the clip itself matter: another name there makes nothing stale.
    assert REFITTING.sources(match, "second")["people"]["first"] == {"0": "ann"}


def test_names_beyond_the_roster_are_refused(tiny, tmp_path):
    with pytest.raises(InputError, match="nobody"):
        register(Store.create(tmp_path / "p"), halves(tiny, tmp_path / "m", first={0: "nobody"}))


@pytest.mark.slow
def test_shapes_of_a_named_person_are_pooled_over_clips(tiny, tmp_path):
    folder, store = halves(tiny, tmp_path / "match"), Store.create(tmp_path / "project")
    name = register(store, folder)[0].match_id

    def compute():
        opened, found = open_match(store, name), {}
        for stage in METHOD:
            for unit in plan_run(store, opened, {}):
                if unit.recipe.stage == stage.name:
                    if not unit.published:
                        task_of(stage).fn(unit.work(store.url, opened, "0001"))
                    place = (name, *unit.name.split("/"), unit.key)
                    found[unit.name] = store.open_result(*place)
        return found

    results = compute()
    before, after = (results[f"body_fitting/{clip}"] for clip in ("first", "second"))
    apart = before["joints"].values[-1, :, None, 5:] - after["joints"].values[0, None, :, 5:]
    away = np.linalg.norm(apart, axis=-1).mean(axis=-1)
    one, two = np.unravel_index(int(np.nanargmin(away)), away.shape)
    named = [int(before["person"].values[one]), int(after["person"].values[two])]
    halves(tiny, folder, first={named[0]: "ann"}, second={named[1]: "ann"})
    again = compute()["refitting/first"]
    np.testing.assert_array_equal(np.flatnonzero(again["pooled"].values), [one])
    own, pooled = (np.trace(x["betas_covariance"].values[one]) for x in (before, again))
    # Another clip as long, with the detector's offsets in common.
    assert 0.3 * own < pooled < 0.95 * own


def test_detections_stay_and_all_later_stages_are_made_from_those_found_again(tmp_path):
    store, folder = Store.create(tmp_path / "project"), tmp_path / "match"
    clips = [("first", 0, 5), ("second", 6, 5)]
    write_filmed(folder, {"left": [0] * 12, "right": [10] * 12}, clips)
    units = keys(store, folder, 3)
    assert not any(name.startswith("redetection") for number, name in units if number == 1)
    for (number, name), unit in units.items():
        if number == 1:
            continue
        inputs, (stage, _, which) = unit.recipe.inputs, name.partition("/")
        if stage == "detection":
            assert unit.key == units[1, name].key
        if stage == "redetection":
            clip = which.partition(".")[2]
            assert inputs[f"detection/{which}"] == units[1, f"detection/{which}"].key
            for before in (f"filtering/{clip}", f"body_fitting/{clip}", f"tracking/{clip}"):
                assert inputs[before] == units[number - 1, before].key
        if stage in (*LATER, "filtering"):
            mine = {each for each in inputs if each.startswith("redetection/")}
            clips = ("first", "second") if which == "cameras" else (which,)
            assert mine == {f"redetection/{cam}.{c}" for cam in ("left", "right") for c in clips}
            assert all(inputs[each] == units[number, each].key for each in mine)


def run_passes(store, match, overrides, passes):
    """Runs of so many passes over the method."""
    stages = selected_stages(None, None)
    for number in range(1, passes + 1):
        for unit in plan_run(store, match, overrides, iteration=number):
            if not unit.published:
                publish_stand_in(store, match, unit)
        log = RunLog.begin(store, match, stages, overrides, iteration=number)
        for stage in stages:
            log.reuse(log.plan.plan_stage(stage))
        log.close()
    return latest_run(store, match.match_id)


@pytest.mark.parametrize("start", ["tracking", "body_fitting"])
def test_a_later_stage_goes_on_with_the_pass_that_the_latest_run_was_made_of(clips, start):
    store, folder = clips
    match, _ = register(store, folder)
    run_passes(store, match, {}, 2)
    latest = run_passes(store, match, OTHER, 2)
    stages = selected_stages(start, None)
    asked = OTHER if start == "tracking" else {}
    plan = RunPlan.begin(Gatekeeper(store, match, "never"), stages, asked, latest, 1)
    assert plan.iteration == 2
    first = {unit.name: unit.key for unit in plan_run(store, match, OTHER)}
    assert plan.before["filtering/first"] == first["filtering/first"]
    planned = plan.plan_stage(stages[0])
    assert {unit.key for unit in planned} <= set(latest.results.values())
    assert {unit.iteration for unit in planned} == {2}


@pytest.mark.parametrize("text", ["tracking.gate_m=true", "detection.zooms=[true, 2]"])
def test_true_is_no_number(text):
    with pytest.raises(UsageError, match="number") as refused:
        parse_overrides([text])
    assert refused.value.found == text.partition("=")[2]
