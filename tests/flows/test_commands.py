"""The table of commands: every entry loads, and listing them imports none."""

import os
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from flows.cli.app import COMMANDS, app, summary


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_loads_and_is_listed_with_its_help(name):
    commands = typer.main.get_command(app)
    command = commands.get_command(typer.Context(commands), name)
    assert command.name == name
    first = " ".join(command.help.partition("\n\n")[0].split())
    assert first == summary(name)
    assert hasattr(command, "commands") or "Example: worldpose" in command.help
    listed = CliRunner().invoke(app, ["--help"]).output
    assert f"\n  {name} " in listed


def test_a_run_imports_nothing_that_only_draws():
    script = (
        "import sys\n"
        "import flows.cli.run, flows.match, tasks.preload\n"
        "assert 'matplotlib' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_pages_import_what_opens_results_when_somebody_looks_at_one():
    # xarray and pandas take 90 MB, of the 500 that a process of a service may have.
    script = "import sys, flows.web.app\nassert not {'xarray', 'pandas'} & set(sys.modules)\n"
    subprocess.run([sys.executable, "-c", script], check=True)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_the_program_answers_without_an_orchestrator_or_a_numeric_library(option):
    script = (
        "import sys\n"
        f"sys.argv = ['worldpose', '{option}']\n"
        "from flows.cli import main\n"
        "try:\n"
        "    main()\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "heavy = {'prefect', 'dask', 'distributed', 'torch', 'numpy', 'cv2', 'pydantic'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_a_shell_completes_the_names_of_commands():
    script = "import sys; sys.argv = ['worldpose']; from flows.cli import main; main()"
    typed = {
        "_WORLDPOSE_COMPLETE": "complete_bash",
        "COMP_WORDS": "worldpose re",
        "COMP_CWORD": "1",
    }
    answer = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, **typed},
        check=True,
        capture_output=True,
        text=True,
    )
    assert sorted(answer.stdout.split()) == ["release", "report", "reprocess", "review"]


def test_a_misspelt_command_names_the_one_that_may_be_meant():
    answer = CliRunner().invoke(app, ["simualte"])
    assert answer.exit_code == 2
    assert "No such command 'simualte'. Did you mean simulate?" in answer.output
