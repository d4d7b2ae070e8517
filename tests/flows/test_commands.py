"""The table of commands, and commands that report on matches without running one."""

import json
import os
import subprocess
import sys

import pytest
import typer
import yaml
from command_line import invoke
from run_records import calibration, match_spec, run_record

from data_contracts.run import UnitFailure, WaitingUnit
from flows.cli import run as run_command
from flows.cli.app import COMMANDS, app, summary
from flows.registering import open_for_review, register
from flows.web.draft_folder import build
from worldpose.errors import InputError, UsageError
from worldpose.formats.calibration_writer import write_calibration_toml
from worldpose.store.store import Store


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_loads_and_is_listed_with_its_help(name):
    commands = typer.main.get_command(app)
    command = commands.get_command(typer.Context(commands), name)
    assert command.name == name
    first = " ".join(command.help.partition("\n\n")[0].split())
    assert first == summary(name)
    assert hasattr(command, "commands") or "Example: worldpose" in command.help
    listed = invoke("--help").output
    assert f"\n  {name} " in listed


@pytest.mark.parametrize(
    ("modules", "unwanted"),
    [
        ("flows.cli.run, flows.match, tasks.preload", "matplotlib"),
        # 90 MB, of the 500 that a process of a service may have.
        ("flows.web.app", "xarray pandas"),
    ],
)
def test_runs_and_pages_import_nothing_that_only_draws_or_opens_results(modules, unwanted):
    script = f"import sys, {modules}\nassert not set({unwanted.split()}) & set(sys.modules)\n"
    subprocess.run([sys.executable, "-c", script], check=True)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_the_program_answers_without_an_orchestrator_or_a_numeric_library(option):
    script = f"""
import sys
sys.argv = ["worldpose", "{option}"]
from flows.cli import main
try:
    main()
except SystemExit as end:
    assert not end.code
heavy = {{"prefect", "dask", "distributed", "torch", "numpy", "cv2", "pydantic"}}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_a_shell_completes_the_names_of_commands():
    typed = {
        "_WORLDPOSE_COMPLETE": "complete_bash",
        "COMP_WORDS": "worldpose re",
        "COMP_CWORD": "1",
    }
    script = "import sys; sys.argv = ['worldpose']; from flows.cli import main; main()"
    command, environment = [sys.executable, "-c", script], {**os.environ, **typed}
    answer = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert sorted(answer.stdout.split()) == ["release", "report", "reprocess", "review"]


def test_a_misspelt_command_names_the_one_that_may_be_meant():
    answer = invoke("simualte")
    assert answer.exit_code == 2
    assert "No such command 'simualte'. Did you mean simulate?" in answer.output


def made(folder, match_id, pitch=None):
    """A match with two cameras, one of them calibrated, that saw people in frames 0 to 9."""
    clips = {"clip": {"frame_count": 10}}
    spec = match_spec(["cam0", "cam1"], clips, (640, 480), match_id=match_id, pitch=pitch)
    (folder / "detections").mkdir(parents=True)
    (folder / "match.yaml").write_text(yaml.safe_dump(spec.model_dump(mode="json")))
    person = {"category_id": 1, "bbox": [90.0, 90.0, 20.0, 20.0], "score": 0.9}
    for place, camera in enumerate(spec.cameras):
        points = {"keypoints": [100.0 + place + len(match_id), 100.0, 0.9] * 17}
        people = [person | points | {"image_id": frame} for frame in range(10)]
        (folder / "detections" / f"{camera.id}.json").write_text(json.dumps(people))
    small = calibration("cam0", image_size=(640, 480), principal_point_px=(320.0, 240.0))
    write_calibration_toml(folder / "calibration.toml", {"cam0": small})
    return folder


@pytest.fixture
def store(tmp_path):
    return Store.create(str(tmp_path / "project"))


def said(store, *arguments):
    return invoke(*arguments, "--project", store.url)


def test_settings_are_not_listed_and_changed_at_once(store):
    for asked in (["--list"], ["--describe", "iterations"]):
        answer = said(store, "settings", *asked, "--set", "iterations=2")
        assert answer.exit_code != 0
    assert "iterations" not in json.loads(said(store, "settings", "--json").output)["settings"]


def test_an_edit_of_match_yaml_that_the_files_do_not_bear_out_is_refused(store, tmp_path):
    folder = made(tmp_path / "a", "a")
    register(store, folder, unfinished=True)
    content = yaml.safe_load((folder / "match.yaml").read_text())
    content["cameras"][1]["offset_frames"] = 500
    (folder / "match.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match="the camera's offset_frames"):
        open_for_review(store, "a")
    assert store.registration("a").spec.cameras[1].offset_frames == 0
    content["cameras"][1]["offset_frames"] = 2
    (folder / "match.yaml").write_text(yaml.safe_dump(content))
    assert open_for_review(store, "a").folder.spec.cameras[1].offset_frames == 2


@pytest.mark.parametrize(
    ("pitch", "told"),
    [
        (None, "to be clicked first: cam1; worldpose review serve shows the pages"),
        (
            "none",
            "no calibration of cam1: on a pitch, delete the line `pitch: none` of match.yaml, "
            "repeat this command, and click the markings on the pages; elsewhere, see worldpose "
            "locate-cameras, or add the cameras to calibration.toml",
        ),
    ],
)
def test_a_camera_without_calibration_is_sent_where_it_can_get_one(store, tmp_path, pitch, told):
    assert told in said(store, "ingest", str(made(tmp_path / "a", "a", pitch))).stdout


def ended(state):
    """The record of a run that ended so."""
    waiting = [
        WaitingUnit(unit=f"detection/{name}", request=name, reasons=("",), rejected=name == "cam2")
        for name in ("cam0", "cam1", "cam2")
    ]
    failed = [UnitFailure(unit="tracking/clip", error="InputError", message="nobody")]
    about = {"executed": ("ingest/cam0",), "blocked": ("triangulation/clip",)}
    about["failed"] = failed if state in ("failed", "partial") else ()
    about["waiting"] = waiting if state == "waiting" else ()
    return run_record(match_id="a", state=state, **about)


@pytest.mark.parametrize(
    ("state", "code", "told"),
    [
        ("complete", 0, "is complete: 1 computed, 0 reused, 0 failed"),
        ("failed", 1, "is failed: 1 computed, 0 reused, 1 failed"),
        ("failed", 1, "next: worldpose why a/tracking/clip"),
        ("waiting", 3, "2 reviews pending, 1 rejected and to be corrected:"),
        ("partial", 4, "1 failed and 1 blocked by that"),
    ],
)
def test_the_exit_code_of_a_run_says_how_it_ended(state, code, told, store, tmp_path, monkeypatch):
    register(store, made(tmp_path / "a", "a"), unfinished=True)
    monkeypatch.setattr(run_command, "find_match", open_for_review)  # cam1 is not calibrated
    monkeypatch.setattr(run_command, "run_match", lambda *_: ended(state))
    answer = said(store, "run", "a")
    assert (answer.exit_code, told in answer.stdout) == (code, True)
    assert "1.0 s; this command: 0." in answer.stdout  # less than its run took: an earlier one
    as_json = said(store, "run", "a", "--json")
    assert as_json.exit_code == code
    assert json.loads(as_json.stdout)["failed"] == (state in ("failed", "partial"))


def test_of_several_folders_the_good_ones_are_taken_in_and_the_others_said(store, tmp_path):
    good, none = str(made(tmp_path / "a", "a")), str(tmp_path / "none")
    assert said(store, "ingest", none).exit_code == 1
    answer = said(store, "ingest", none, good)
    assert (answer.exit_code, store.matches()) == (4, ("a",))
    assert f"error: {none}" in answer.stderr
    assert said(store, "ingest", good).exit_code == 0


def test_a_run_that_has_not_ended_is_told_and_listed(store, tmp_path):
    register(store, made(tmp_path / "a", "a"), unfinished=True)
    killed = store.reserve_run("a")
    store.finish_run(run_record(match_id="a", run_id=store.reserve_run("a")))
    assert said(store, "diff", "a/2", "a").exit_code == 0
    told = r"run 1 of match a .*one of 0002, found an unfinished run. List them: worldpose status a"
    with pytest.raises(InputError, match=told):
        raise said(store, "diff", "a/1", "a/2").exception
    assert said(store, "settings", "a", "--set", "detection.batch=2").exit_code == 0
    told = said(store, "status", "a").stdout
    assert "a: runs that ended: 0002; that have not: 0001\n" in told
    assert "settings of its next run: detection.batch=2\n" in told
    assert "forget it: worldpose gc --delete --forget a/0001\n" in said(store, "gc").stdout
    removed = said(store, "gc", "--delete", "--forget", f"a/{killed}").stdout
    assert "removed: 1 x reservation of a dead run (" in removed
    assert "removed: nothing (0 B)" in said(store, "gc", "--delete").stdout


@pytest.mark.parametrize(("frames", "is_told"), [(35, False), (36, True)])
def test_a_clip_much_longer_than_its_2d_poses_is_told_where_files_are_given(
    store, tmp_path, frames, is_told
):
    folder, draft = made(tmp_path / "a", "a"), tmp_path / "draft"
    content = yaml.safe_load((folder / "match.yaml").read_text())
    content["clips"][0]["frame_count"] = frames
    (folder / "match.yaml").write_text(yaml.safe_dump(content))
    told = f"clip clip: it has frames 0 to {frames - 1}, and 2D poses only in frames 0 to 9."
    answer = said(store, "ingest", str(folder))
    assert (answer.exit_code, told in answer.stderr) == (0, is_told)
    (draft / "match").mkdir(parents=True)
    folder.rename(draft / "own")
    _, notes = build(Store.open_or_new(tmp_path / "new"), content, draft, {})
    assert any(told in note for note in notes) == is_told
    _, notes = build(store, content, draft, {}, "a")  # ingest told it
    assert not any(told in note for note in notes)


def test_a_match_of_the_second_world_is_made_by_name(tmp_path):
    listed = invoke("simulate", "--scenario", "list", "--json")
    assert "foreign-mixed" in json.loads(listed.stdout)["scenarios"]
    words = ["simulate", "--scenario", "foreign-lab", "--seed", "1", "--duration", "0.2", "--json"]
    done = invoke(*words, "--out", tmp_path / "lab")
    assert json.loads(done.stdout)["match"] == "foreign-lab-1-0.2s"
    assert (tmp_path / "lab" / "reference" / "world.json").is_file()


@pytest.mark.parametrize(
    ("scenario", "option"),
    [("foreign-lab", "--render"), ("foreign-lab", "--mocap"), ("tiny", "--recordings")],
)
def test_an_option_that_a_scenario_does_not_have_is_refused(tmp_path, scenario, option):
    value = [] if option == "--render" else [tmp_path]
    done = invoke("simulate", "--scenario", scenario, "--out", tmp_path / "out", option, *value)
    assert isinstance(done.exception, UsageError)
    assert done.exception.where == option
    assert not (tmp_path / "out").exists()


def clicks_of_places(file, camera, shift):
    """Labelled places [m] in an image of a camera, of which the pitch names none."""
    places = [(x + shift, y) for x in (-13.3, 3.3) for y in (4.4, 14.4)]
    image = {"id": 1, "file_name": f"{camera}.png", "width": 640, "height": 480}
    numbers = [value for x, y in places for value in (200.0 + 10.0 * x, 300.0 - 10.0 * y, 2)]
    marked = {"id": 1, "image_id": 1, "category_id": 1, "keypoints": numbers}
    named = {"id": 1, "name": "pitch", "keypoints": [f"{x:.2f}, {y}" for x, y in places]}
    content = {"images": [image], "annotations": [marked], "categories": [named]}
    file.write_text(json.dumps(content))
    return str(file)


def test_points_join_the_pitch_before_the_first_run_and_are_refused_unwritten_after(
    store, tmp_path
):
    folder = made(tmp_path / "a", "a")
    assert said(store, "ingest", str(folder)).exit_code == 0
    first, second = (clicks_of_places(tmp_path / f"{n}.json", "cam1", n) for n in (0, 1))
    words = ["import", "--out", str(folder), "--clicks"]
    assert said(store, *words, first).exit_code == 0
    answer = said(store, "ingest", str(folder))
    assert (answer.exit_code, answer.stdout.splitlines()[0]) == (0, "registered a")
    assert "at_3.30_4.40" in open_for_review(store, "a").folder.pitch.points
    store.finish_run(run_record(match_id="a"))
    (clicks,) = (folder / "annotations" / "static_calibration").iterdir()
    clicks.unlink()
    before, pitch = sorted(folder.rglob("*")), folder / "pitch.json"
    with pytest.raises(InputError, match=r"a/0001; nothing was written.*gc --delete --forget a/0"):
        raise said(store, *words, second).exception
    (tmp_path / "survey.csv").write_text("name,x,y\n")
    pitch.rename(tmp_path / "pitch.json")
    with pytest.raises(InputError, match="a/0001; nothing was written"):
        survey = ("--pitch", tmp_path / "survey.csv", "--out", folder)
        raise said(store, "import", *survey).exception
    (tmp_path / "pitch.json").rename(pitch)
    assert sorted(folder.rglob("*")) == before
    assert said(store, *words, first).exit_code == 0  # the pitch has its points
    assert said(store, "ingest", str(folder)).exit_code == 0
    for file in (pitch, folder / "match.yaml"):
        file.write_text(file.read_text() + "\n")
    with pytest.raises(InputError, match=r"found changes in pitch.json\. Restore"):
        open_for_review(store, "a")
    assert said(store, "gc", "--delete", "--forget", "a/0001").exit_code == 0
    assert open_for_review(store, "a")
