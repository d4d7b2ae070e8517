"""The table of commands: every entry loads, and listing them imports none."""

import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest
import typer
from typer.testing import CliRunner

from flows import renames
from flows.cli.app import COMMANDS, app, summary
from flows.method import METHOD
from flows.settings import parse_overrides
from worldpose.errors import UsageError


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_loads_and_is_listed_with_its_help(name):
    commands = typer.main.get_command(app)
    command = commands.get_command(typer.Context(commands), name)
    assert command.name == name
    first = " ".join(command.help.partition("\n\n")[0].split())
    assert first == summary(name)
    listed = CliRunner().invoke(app, ["--help"]).output
    assert f"\n  {name} " in listed


def test_the_list_of_commands_and_the_version_import_no_estimator():
    script = (
        "import sys\n"
        "from flows.cli.app import app\n"
        "for option in ('--help', '--version'):\n"
        "    app([option], standalone_mode=False)\n"
        "loaded = {'numpy', 'pydantic', 'zarr', 'cv2', 'prefect', 'dask'} & set(sys.modules)\n"
        "assert not loaded, loaded\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_a_run_imports_nothing_that_only_draws():
    script = (
        "import sys\n"
        "import flows.cli.run, flows.match, tasks.preload\n"
        "assert 'matplotlib' not in sys.modules\n"
    )
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
        "heavy = {'prefect', 'dask', 'distributed', 'torch', 'numpy', 'scipy', 'xarray', 'cv2'}\n"
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
    assert sorted(answer.stdout.split()) == ["report", "reprocess", "review"]


def test_the_version_is_that_of_the_installed_package():
    assert CliRunner().invoke(app, ["--version"]).output.strip() == version("worldpose")


def test_a_misspelt_command_names_the_one_that_may_be_meant():
    answer = CliRunner().invoke(app, ["simualte"])
    assert answer.exit_code == 2
    assert "No such command 'simualte'. Did you mean simulate?" in answer.output


def test_a_group_lists_its_commands():
    answer = CliRunner().invoke(app, ["body", "--help"])
    assert answer.exit_code == 0
    assert "install" in answer.output.partition("Commands:")[2]


@pytest.mark.parametrize(
    ("arguments", "present"),
    [
        (["times", "m"], "worldpose times is now worldpose timings"),
        (["serve", "--quiet=3"], "--quiet is now --settle-time"),
        (["serve", "--at-once", "2"], "--at-once is now --max-concurrent"),
    ],
)
def test_a_former_name_is_refused_with_the_present_one(arguments, present):
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 2
    assert present in answer.output


def test_a_former_setting_is_refused_with_the_present_one():
    for stage, names in renames.SETTINGS.items():
        for former, present in names.items():
            with pytest.raises(UsageError, match=re.escape(f"of the setting, {present}, found")):
                parse_overrides([f"{stage}.{former}=1"])


def test_a_former_name_in_a_group_of_settings_is_refused_with_the_present_one():
    with pytest.raises(UsageError, match=re.escape('.given={"rotation_rad": VALUE}')):
        parse_overrides(['bundle_adjustment.given={"rotation": 0.001}'])


def is_setting(settings, name):
    """Return whether settings have a field of this name; a dot leads into a group."""
    field, dot, rest = name.partition(".")
    found = settings.model_fields.get(field)
    return found is not None and (not dot or is_setting(found.annotation, rest))


def test_every_present_name_exists():
    for stage in METHOD:
        for former, present in renames.SETTINGS.get(stage.name, {}).items():
            assert is_setting(stage.settings, present), (stage.name, present)
            assert not is_setting(stage.settings, former), (stage.name, former)
    assert set(renames.COMMANDS.values()) <= set(COMMANDS)
    assert not set(renames.COMMANDS) & set(COMMANDS)
    for command, options in renames.OPTIONS.items():
        known = CliRunner().invoke(app, [command, "--help"]).output
        for former, present in options.items():
            assert present in known
            assert former not in known


def test_settings_in_the_record_of_an_earlier_version_get_their_present_names():
    former, present = next(iter(renames.SETTINGS["triangulation"].items()))
    recorded = {"triangulation": {former: False, "min_views": 3}, "ingest": {}}
    renamed = {"triangulation": {present: False, "min_views": 3}, "ingest": {}}
    assert renames.rename_settings(recorded) == renamed


def test_a_removed_setting_is_refused_with_what_replaces_it_and_not_read_from_records():
    for stage, names in renames.REMOVED.items():
        for removed, replacement in names.items():
            by_name = {stage.name: stage.settings for stage in METHOD}
            other, _, field = replacement.partition(".")
            assert is_setting(by_name[other], field) and not is_setting(by_name[stage], removed)
            with pytest.raises(UsageError, match=re.escape(f"Write --set {replacement}=VALUE")):
                parse_overrides([f"{stage}.{removed}=1"])
            recorded = {stage: {removed: 1, "min_views": 4}}
            assert renames.rename_settings(recorded) == {stage: {"min_views": 4}}


def test_settings_of_a_group_get_their_present_names():
    recorded = {"bundle_adjustment": {"frames": 9, "solver": {"iterations": 5, "damping": 0.1}}}
    renamed = {
        "bundle_adjustment": {"max_frames": 9, "solver": {"max_iterations": 5, "damping": 0.1}}
    }
    assert renames.rename_settings(recorded) == renamed
