"""Writes the pages that repeat other files: settings, command line and API, and the results.

The tables of the results are those that `python benchmarks/run.py NAME --json` wrote.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from data_contracts.records import field_docstrings
from flows.cli.app import COMMANDS, app
from flows.method import METHOD
from flows.stage import Stage

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from registry import Table, format_table

if TYPE_CHECKING:
    from typer._click.core import Command


def write_reference(folder: Path) -> None:
    """Write `settings.md`, `command_line.md` and `api.md`."""
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "settings.md", settings_page())
    write(folder / "command_line.md", command_page())
    write(folder / "api.md", api_page())


RESULT_PAGES = {
    "real": ("Real data", "real shelf shelf_subsets mvor pose2sim_demo"),
    "detection": ("Detection", "detection stills panorama_people finetuning"),
    "static_cameras": (
        "Static cameras",
        "static_calibration static_accuracy camera_projection camera_faults "
        "camera_changes synchronization "
        "proposals pitch_lines still_cameras bundle_adjustment",
    ),
    "people": (
        "People, joints and bodies",
        "tracking triangulation body_fitting challenge second_world",
    ),
    "moving_cameras": ("Moving cameras", "broadcast_accuracy broadcast_clip broadcast_cuts"),
    "whole_runs": ("Time and memory", "run_memory data_set_size"),
}
"""Title of each page of results, and the benchmarks whose tables it has."""


def write_results(data: Path, folder: Path) -> None:
    """Write a page for each part of the method from the tables that benchmarks recorded.

    Raises:
        ValueError: a file is of a benchmark that no page has.
    """
    found = {path.stem: json.loads(path.read_text()) for path in sorted(data.glob("*.json"))}
    folder.mkdir(parents=True, exist_ok=True)
    for page, (title, names) in RESULT_PAGES.items():
        results = [found.pop(name) for name in names.split() if name in found]
        write(folder / f"{page}.md", result_page(title, results))
    if found:
        raise ValueError(f"{data}: no page of results has {', '.join(found)}; add it to one")


def result_page(title: str, results: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of one page: for each benchmark its command, machine and tables."""
    yield f"# {title}"
    for result in results:
        machine, versions = result["machine"], result["versions"]
        yield ""
        yield f"## {result['benchmark']}"
        yield ""
        yield f"    {result['command']}"
        yield ""
        yield f"{result['date']}, {result['seconds']:.0f} s, worldpose {versions['worldpose']}."
        yield f"{machine['cpu']}, {machine['cores']} cores, {machine['memory_gb']:.0f} GB."
        for table in result["tables"].values():
            yield ""
            yield format_table(Table(**table)).rstrip()
    if not results:
        yield ""
        yield "No benchmark of this page has a recorded result."


def write(path: Path, lines: Iterator[str]) -> None:
    """Write a page unless it has this content already: Sphinx rebuilds what is newer."""
    text = "\n".join(lines) + "\n"
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def settings_page() -> Iterator[str]:
    """Yield the lines of a page with a table of settings for each stage."""
    yield "# Settings"
    yield ""
    yield "`worldpose run MATCH --set STAGE.NAME=VALUE` changes a setting."
    for stage in METHOD:
        if stage.settings.model_fields:
            yield from stage_settings(stage)


def stage_settings(stage: Stage) -> Iterator[str]:
    """Yield the heading and the table of one stage."""
    yield ""
    yield f"## {stage.name}"
    yield ""
    yield "| setting | default | meaning |"
    yield "| --- | --- | --- |"
    defaults = stage.settings().model_dump(mode="json")
    described = field_docstrings(stage.settings)
    for name in stage.settings.model_fields:
        meaning = " ".join(described.get(name, "").split()).replace("|", "\\|")
        yield f"| `{name}` | `{json.dumps(defaults[name])}` | {meaning} |"


def command_page() -> Iterator[str]:
    """Yield the lines of a page with every command, its arguments and its options."""
    yield "# Command line"
    yield ""
    yield "Exit codes: 0 done, 1 failed, 2 usage, 3 waits for review, 4 partial."
    group = typer.main.get_command(app)
    context = typer.Context(group, info_name="worldpose")
    for name in COMMANDS:
        command = group.get_command(context, name)
        inner = getattr(command, "commands", None)
        if inner is None:
            yield from one_command(f"worldpose {name}", command)
        else:
            for each, subcommand in inner.items():
                yield from one_command(f"worldpose {name} {each}", subcommand)


def one_command(path: str, command: Command) -> Iterator[str]:
    """Yield the section of one command."""
    yield ""
    yield f"## {path}"
    yield ""
    yield command.help or ""
    yield ""
    yield "| argument or option | default | meaning |"
    yield "| --- | --- | --- |"
    for each in command.params:
        names = ", ".join(f"`{name}`" for name in (*each.opts, *each.secondary_opts))
        if each.param_type_name == "argument":
            names = f"`{each.name.upper()}`"
        unset = each.default in (None, ...) or callable(each.default)
        default = "" if unset else f"`{each.default}`"
        meaning = " ".join((getattr(each, "help", None) or "").split()).replace("|", "\\|")
        yield f"| {names} | {default} | {meaning} |"


def api_page() -> Iterator[str]:
    """Yield the lines of the page of the library: its docstring and all names that it offers."""
    yield "# API"
    yield ""
    yield "```{eval-rst}"
    yield ".. automodule:: worldpose"
    yield "   :members:"
    yield "   :imported-members:"
    yield "```"
