"""Writes the pages of the reference that repeat the code: settings, command line and API."""

from __future__ import annotations

import importlib
import json
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

import worldpose
from data_contracts.records import field_docstrings
from flows.cli.app import COMMANDS, app
from flows.method import METHOD
from flows.stage import Stage

if TYPE_CHECKING:
    from typer._click.core import Command

INTERNAL = {"worldpose.simulation"}
"""Packages that a user of the library does not import."""


def write_reference(folder: Path) -> None:
    """Write `settings.md`, `command_line.md`, `api.md` and a page for each package.

    Pages of packages that no longer exist are removed: Sphinx warns of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write(folder / "settings.md", settings_page())
    write(folder / "command_line.md", command_page())
    packages = ["worldpose", *sorted(public_packages())]
    for page in folder.glob("worldpose*.md"):
        if page.stem not in packages:
            page.unlink()
    for name in packages:
        write(folder / f"{name}.md", package_page(name))
    write(folder / "api.md", api_page(packages))


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


def public_packages() -> Iterator[str]:
    """Yield the packages of the library that list what they offer."""
    for found in pkgutil.iter_modules(worldpose.__path__, "worldpose."):
        offers_names = getattr(importlib.import_module(found.name), "__all__", ())
        if found.ispkg and found.name not in INTERNAL and offers_names:
            yield found.name


def api_page(packages: list[str]) -> Iterator[str]:
    """Yield the lines of the index of the API."""
    yield "# API"
    yield ""
    yield "```{toctree}"
    yield ":maxdepth: 1"
    yield ""
    yield from packages
    yield "```"


def package_page(name: str) -> Iterator[str]:
    """Yield the lines of the page of one package: its docstring and all names it offers."""
    yield f"# {name}"
    yield ""
    yield "```{eval-rst}"
    yield f".. automodule:: {name}"
    if name != "worldpose":  # its functions stand on the pages of their packages
        yield "   :members:"
        yield "   :imported-members:"
    yield "```"
    if name == "worldpose":
        yield ""
        yield "| name | package |"
        yield "| --- | --- |"
        for member in worldpose.__all__:
            where = getattr(getattr(worldpose, member), "__module__", name)
            packages = [each for each in public_packages() if where.startswith(each)]
            package = max(packages, key=len, default=name)
            link = f"[{package}]({package}.md)" if packages else f"`{where}`"
            yield f"| `{member}` | {link} |"
