"""Writes the pages of the reference that repeat the code: settings, command line and API."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from data_contracts.records import field_docstrings
from flows.cli.app import COMMANDS, app
from flows.method import METHOD
from flows.stage import Stage

if TYPE_CHECKING:
    from typer._click.core import Command


def write_reference(folder: Path) -> None:
    """Write `settings.md`, `command_line.md` and `api.md`."""
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "settings.md", settings_page())
    write(folder / "command_line.md", command_page())
    write(folder / "api.md", api_page())


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
