"""Bad input: one clear message with file, key, expected, found and what to do; nothing changed."""

import errno
import json
import shutil
from pathlib import Path

import pytest
import yaml
from command_line import TINY, worldpose

from flows.cli import main

pytestmark = pytest.mark.usefixtures("server")


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "prefect" not in path.relative_to(folder).parts
    }


@pytest.fixture
def match(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "other")


def a_detection_file(match):
    return sorted((match / "detections").glob("*.npz"))[1]


def rename_match(match):
    spec = yaml.safe_load((match / "match.yaml").read_text())
    spec["match_id"] = "other"
    (match / "match.yaml").write_text(yaml.safe_dump(spec))
    return spec


def truncate(match):
    path = a_detection_file(match)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return [path.name, "expected", "Write or export it again"]


def a_clicked_file(match):
    return sorted((match / "annotations" / "static_calibration").iterdir())[1]


def missing_clicks(match):
    path = a_clicked_file(match)
    path.unlink()
    return [f"missing camera {path.stem}", path.name, "at least four points", "calibration.toml"]


def unknown_key(match):
    path = match / "match.yaml"
    path.write_text(path.read_text() + "framerate: 25\n")
    return ["match.yaml", "framerate"]


@pytest.mark.parametrize("spoil", [truncate, unknown_key, missing_clicks])
def test_a_spoilt_match_is_refused(spoil, match, project_copy):
    rename_match(match)
    told = spoil(match)
    before = contents(project_copy), contents(match)
    answer = worldpose("run", match, "--project", project_copy)
    assert answer.code == 1
    assert "Traceback" not in answer.err
    messages = [line for line in answer.err.splitlines() if "error:" in line or "Error:" in line]
    assert len(messages) == 1, answer.err
    for words in told:
        assert words in messages[0]
    assert "expected" in messages[0] and "found" in messages[0]
    after = contents(project_copy), contents(match)
    assert after[1] == before[1]
    assert changed_results(before[0], after[0]) == set()


def changed_results(before, after):
    return {path for path in before | after if before.get(path) != after.get(path)}


def test_a_duplicate_under_another_id_is_refused(match, project_copy):
    rename_match(match)
    before = contents(project_copy)
    answer = worldpose("ingest", match, "--project", project_copy)
    assert answer.code == 1
    assert f"the content of {TINY}" in answer.err
    assert f"use {TINY}" in answer.err
    assert contents(project_copy) == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--set", "triangulation.min_view=3"], "Did you mean 'min_views'"),
        (["--set", "triangulaton.min_views=3"], "Did you mean 'triangulation'"),
        (["--set", "triangulation.min_views=many"], "integer"),
        (["--set", "triangulation.min_views=" + "[" * 3000], "integer"),
        (["--set", "triangulation.pixel_noise_px=NaN"], "a finite number"),
        (["--set", "min_views"], "stage.name=value"),
        (["--from", "triangulation", "--until", "tracking"], "Swap the two stages"),
        (["--until", "body"], "one of ingest, proposal, static_calibration, detection"),
    ],
)
def test_a_setting_or_stage_that_does_not_exist_is_a_usage_error(
    arguments, told, tiny, project_copy
):
    before = contents(project_copy)
    answer = worldpose("run", tiny, "--project", project_copy, *arguments)
    assert answer.code == 2
    assert told in answer.err
    assert contents(project_copy) == before


@pytest.mark.parametrize("command", ["run", "ingest"])
def test_a_folder_that_is_not_there_leaves_no_project_behind(command, tmp_path):
    answer = worldpose(command, tmp_path / "typo", "--project", tmp_path / "new")
    assert answer.code == 1
    assert "typo" in answer.err
    assert list(tmp_path.iterdir()) == []


def test_a_match_folder_that_is_gone_hides_neither_results_nor_other_matches(match, tmp_path):
    project = tmp_path / "worldpose-data"
    assert worldpose("run", match, "--project", project, "--until", "triangulation").code == 0
    shutil.rmtree(match)
    status = worldpose("status", "--project", project, "--json")
    assert status.code == 0
    assert str(match) in status.json["matches"][0]["problem"]
    out = ("--out", tmp_path / "out", "--project", project)
    assert worldpose("export", TINY, "--format", "joints", *out).code == 0
    assert worldpose("run", TINY, "--project", project).code == 1


@pytest.mark.parametrize(
    ("arguments", "environment", "told"),
    [
        (["--dask", "tcp://127.0.0.1:9"], {}, "expected a running Dask scheduler"),
        ([], {"PREFECT_API_URL": "http://127.0.0.1:9/api"}, "expected a running Prefect server"),
    ],
)
def test_a_service_that_does_not_answer_is_named(arguments, environment, told, tiny, tmp_path):
    project = ("--project", tmp_path / "new")
    answer = worldpose("run", tiny, *project, *arguments, environment=environment)
    assert answer.code == 1
    assert told in answer.err
    assert "Traceback" not in answer.err


def test_reading_commands_do_not_make_a_project(tmp_path):
    for command in (["status"], ["verify"], ["gc"], ["diff", "a/1", "a/2"]):
        answer = worldpose(*command, "--project", tmp_path / "nowhere")
        assert (answer.code, "worldpose init" in answer.err) == (1, True), answer.err
    assert list(tmp_path.iterdir()) == []


def test_what_the_system_refuses_is_said_as_json_too(monkeypatch, capsys):
    def refused():
        raise PermissionError(errno.EACCES, "Permission denied", "clips/x.mp4")

    monkeypatch.setattr("flows.cli.app.app", refused)
    monkeypatch.setattr("sys.argv", ["worldpose", "status", "--json"])
    monkeypatch.setattr("gc.freeze", lambda: None)  # this process continues
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    said = capsys.readouterr()
    expected = {"error": "PermissionError", "message": "clips/x.mp4: Permission denied"}
    assert json.loads(said.out) == expected
    assert "clips/x.mp4: Permission denied" in said.err


@pytest.mark.parametrize("flags", [[], ["--json"]])
def test_a_bug_is_called_one_and_its_traceback_is_kept(monkeypatch, capsys, flags):
    def broken():
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("flows.cli.app.app", broken)
    monkeypatch.setattr("sys.argv", ["worldpose", "status", *flags])
    monkeypatch.setattr("gc.freeze", lambda: None)  # this process continues
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    assert "This is a bug in worldpose, not in your data" in said.err
    kept = Path(said.err.split("All of it: ")[1].strip())
    assert "ZeroDivisionError: division by zero" in kept.read_text()
    kept.unlink()
    if flags:
        assert json.loads(said.out)["error"] == "InternalError"


def test_a_run_without_people_is_partial_and_says_why(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    (folder / "pitch.json").unlink()
    shutil.rmtree(folder / "annotations")
    spec = yaml.safe_load((folder / "match.yaml").read_text()) | {"pitch": "none"}
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))  # on a pitch, feet place people
    asked = ("--until", "tracking", "--set", "tracking.min_angle_rad=1.57")
    answer = worldpose("run", folder, "--project", tmp_path / "new", *asked)
    assert answer.code == 4
    assert "tracking/clip found no person" in answer.err
    assert "tracking.min_angle_rad asks for 90 (1.57 rad)" in answer.err


def test_settings_can_be_looked_up(tmp_path):
    answer = worldpose("run", "any", "--set", "list", "--json")
    assert answer.code == 0
    assert answer.json["triangulation.min_views"]["default"] == 2
    assert "cameras" in answer.json["triangulation.min_views"]["about"]
