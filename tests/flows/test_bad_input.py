"""Bad input: one clear message with file, key, expected, found and what to do; nothing changed."""

import errno
import json
import shutil
from pathlib import Path

import pytest
import yaml
from command_line import TINY, worldpose

from flows.cli import main
from flows.cli.finetune import _settings, finetune
from worldpose.errors import UsageError

pytestmark = pytest.mark.usefixtures("server")


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "prefect" not in path.relative_to(folder).parts
    }


@pytest.fixture
def match(tiny, tmp_path):
    """A copy of the match under another id."""
    folder = shutil.copytree(tiny, tmp_path / "other")
    describe(folder, match_id="other")
    return folder


def describe(folder, **changes):
    spec = yaml.safe_load((folder / "match.yaml").read_text()) | changes
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))


def truncate(match):
    path = sorted((match / "detections").glob("*.npz"))[1]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return [path.name, "expected", "Write or export it again"]


def missing_clicks(match):
    path = sorted((match / "annotations" / "static_calibration").iterdir())[1]
    path.unlink()
    return [f"missing camera {path.stem}", path.name, "at least four points", "calibration.toml"]


def unknown_key(match):
    describe(match, framerate=25)
    return ["match.yaml", "framerate"]


def duplicate(match):
    return [f"the content of {TINY}", f"use {TINY}"]


@pytest.mark.parametrize("spoil", [truncate, unknown_key, missing_clicks, duplicate])
def test_a_spoilt_match_is_refused(spoil, match, project_copy):
    told = spoil(match)
    before = contents(project_copy), contents(match)
    answer = worldpose("run", match, "--project", project_copy)
    assert answer.code == 1
    assert "Traceback" not in answer.err
    (message,) = [line for line in answer.err.splitlines() if "rror:" in line]
    for words in (*told, "expected", "found"):
        assert words in message
    assert (contents(project_copy), contents(match)) == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--set", "triangulation.min_view=3"], "Did you mean 'min_views'"),
        (["--set", "triangulaton.min_views=3"], "Did you mean 'triangulation'"),
        (["--set", "triangulation.min_views=" + "[" * 3000], "integer"),
        (["--set", "triangulation.pixel_noise_px=NaN"], "a finite number"),
        (["--set", "min_views"], "stage.name=value"),
        (["--from", "triangulation", "--until", "tracking"], "Swap the two stages"),
        (["--body-folder", "/no/such"], "expected a folder with installed bodies"),
        (["--until", "body"], "one of ingest, proposal, static_calibration, detection"),
    ],
)
def test_a_setting_or_stage_that_does_not_exist_is_a_usage_error(arguments, told, tiny, tiny_run):
    before = contents(tiny_run)
    answer = worldpose("run", tiny, "--project", tiny_run, *arguments)
    assert answer.code == 2
    assert told in answer.err
    assert contents(tiny_run) == before


@pytest.mark.parametrize("command", ["run", "ingest"])
def test_a_folder_that_is_not_there_leaves_no_project_behind(command, tmp_path):
    answer = worldpose(command, tmp_path / "typo", "--project", tmp_path / "new")
    assert answer.code == 1
    assert "typo" in answer.err
    assert list(tmp_path.iterdir()) == []


QUICKLY = {"DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "1s"}


@pytest.mark.parametrize(
    ("arguments", "environment", "told"),
    [
        (["--dask", "tcp://127.0.0.1:9"], QUICKLY, "expected a running Dask scheduler"),
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


REFUSED = PermissionError(errno.EACCES, "Permission denied", "clips/x.mp4")


@pytest.mark.parametrize(
    ("error", "name", "told"),
    [
        (REFUSED, "PermissionError", "clips/x.mp4: Permission denied"),
        (ZeroDivisionError("of it"), "InternalError", "a bug in worldpose, not in your data"),
    ],
)
def test_what_the_system_refuses_and_a_bug_are_said_as_json_too(
    error, name, told, monkeypatch, capsys
):
    def broken():
        raise error

    monkeypatch.setattr("flows.cli.app.app", broken)
    monkeypatch.setattr("sys.argv", ["worldpose", "status", "--json"])
    monkeypatch.setattr("gc.freeze", lambda: None)  # this process continues
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert told in said.err and "Traceback" not in said.err
    assert json.loads(said.out)["error"] == name
    if name == "InternalError":
        kept = Path(said.err.split("All of it: ")[1].strip())
        assert "ZeroDivisionError: of it" in kept.read_text()
        kept.unlink()


@pytest.mark.parametrize(
    "starts", [["keypoints=absent"], ["people=a", "people=b"]], ids=["not trained", "twice"]
)
def test_initial_weights_that_would_be_ignored_are_refused(starts, tmp_path):
    with pytest.raises(UsageError, match=f"--start {starts[-1]}"):
        finetune(tmp_path / "labels.json", nets=["people"], starts=starts, project=str(tmp_path))


def test_settings_of_the_training_come_as_one_value_or_each_alone():
    given = _settings(['training={"steps": 7, "seed": 2}', "training.seed=3"]).training
    assert (given.steps, given.seed) == (7, 3)
    with pytest.raises(UsageError, match="valid dictionary"):
        _settings(["training=5", "training.seed=3"])
