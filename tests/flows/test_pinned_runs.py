"""Runs with names: kept by gc, found by name, compared by name."""

import json

import pytest
from command_line import TINY
from typer.testing import CliRunner

from flows.cli.app import app
from worldpose.errors import InputError
from worldpose.store.store import Store


@pytest.fixture
def command(project_copy):
    """The command line in this process, on a project with one finished run."""

    def run(*arguments):
        asked = [*arguments, "--project", str(project_copy)]
        answer = CliRunner().invoke(app, asked, catch_exceptions=True)
        if answer.exception is not None and not isinstance(answer.exception, SystemExit):
            raise answer.exception
        return answer

    return run


def test_a_pinned_run_has_a_name_and_stays(command, project_copy):
    store = Store.open(project_copy)
    second = store.run(TINY).model_copy(update={"run_id": store.reserve_run(TINY)})
    store.finish_run(second)
    assert command("pin", f"{TINY}/0001", "paper", "--who", "Ada").exit_code == 0
    assert "run 0001 is pinned as paper" in command("status").stdout
    assert "run 0001 is pinned as paper" in command("status", TINY).stdout
    answer = command("diff", f"{TINY}/paper", f"{TINY}/0002", "--json")
    compared = json.loads(answer.stdout)["compared"]
    assert {each["kind"] for each in compared} == {"match", "clip", "camera", "player"}
    assert {each["mark"] for each in compared} == {"unchanged"}
    with pytest.raises(InputError, match="not pinned"):
        command("gc", "--forget", f"{TINY}/0001")
    assert "removed 0 things" in command("gc", "--keep-last", "1", "--delete").stdout
    assert command("unpin", f"{TINY}/paper").exit_code == 0
    assert "removed 1 things" in command("gc", "--keep-last", "1", "--delete").stdout
    assert store.runs(TINY) == ("0002",)


def test_status_names_a_damaged_pin(command, project_copy):
    assert command("pin", TINY, "gold", "--who", "Ada").exit_code == 0
    file = project_copy / "pins" / TINY / "gold.json"
    file.write_bytes(file.read_bytes()[:20])
    (row,) = json.loads(command("status", "--json").stdout)["matches"]
    assert f"pins/{TINY}/gold.json" in row["problem"]
    assert row["now"] == "usable with reservations"  # its results can still be used
    assert f"pins/{TINY}/gold.json" in command("status").stdout.replace("\n", "")


@pytest.mark.parametrize("name", ["0007", "latest", "a/b", ""])
def test_a_name_that_is_none_is_refused(command, name):
    with pytest.raises(InputError, match="name of"):
        command("pin", TINY, name, "--who", "Ada")
