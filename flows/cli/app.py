"""Command table of `worldpose`; each command is imported when it is called."""

from __future__ import annotations

import ast
import os
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer.core import TyperGroup

from flows.cli.options import command_of
from worldpose.cache_folder import find_cache_folder

if TYPE_CHECKING:
    from typer._click.core import Command, Context
    from typer._click.formatting import HelpFormatter
    from typer._click.shell_completion import CompletionItem

GROUPS: Final = {
    "Bring a match in": {
        "init": "project:init",
        "simulate": "simulate:simulate",
        "import": "matches:import_command",
        "clips": "programme:clips",
        "ingest": "matches:ingest",
        "calibrate": "calibrate:calibrate",
        "locate-cameras": "locate:locate_cameras",
        "synchronize": "locate:synchronize",
    },
    "Process matches": {
        "run": "run:run",
        "settings": "settings:settings",
        "reprocess": "run:reprocess",
        "serve": "serve:serve",
        "review": "review",
    },
    "Look at results, and hand them on": {
        "status": "project:status",
        "report": "results:report",
        "export": "results:export",
        "release": "data_set:release",
        "evaluate": "evaluate:evaluate",
        "check": "data_set:check",
        "statistics": "data_set:statistics",
    },
    "Find out why": {"why": "lineage:why", "diff": "lineage:diff", "timings": "lineage:timings"},
    "Keep the project in order": {
        "pin": "project:pin",
        "unpin": "project:unpin",
        "verify": "project:verify",
        "gc": "project:gc",
    },
    "Models": {
        "models": "models",
        "body": "body",
        "label": "finetune:label",
        "finetune": "finetune:finetune",
    },
}
"""Heading in the help to commands, each as `module:function` in flows.cli; a module alone is a
group with `commands`."""
COMMANDS: Final = {name: place for group in GROUPS.values() for name, place in group.items()}


class Commands(TyperGroup):
    """All commands, in the order of the table.

    Importing estimators and stores takes seconds, so only the called command is imported.
    """

    def get_command(self, ctx: Context, cmd_name: str) -> Command | None:
        """Import and return a command; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        module, _, function = COMMANDS[cmd_name].partition(":")
        loaded = import_module(f"flows.cli.{module}")
        parent = typer.Typer(add_completion=False, rich_markup_mode=None)
        if not function:  # inside another group, a group of one command stays a group
            for each in loaded.commands.registered_commands:
                each.callback = command_of(each.callback)
            parent.add_typer(loaded.commands, name=cmd_name)
            return typer.main.get_group(parent).commands[cmd_name]
        parent.command(cmd_name)(command_of(getattr(loaded, function)))
        return typer.main.get_command(parent)

    def list_commands(self, ctx: Context) -> list[str]:
        """Return the names of all commands."""
        return list(COMMANDS)

    def resolve_command(
        self, ctx: Context, args: list[str]
    ) -> tuple[str | None, Command | None, list[str]]:
        """Return the called command, or raise an error that suggests one."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            near = get_close_matches(name, COMMANDS)
            meant = f" Did you mean {' or '.join(near)}?" if near else ""
            ctx.fail(f"No such command {name!r}.{meant} worldpose --help lists them.")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Context, formatter: HelpFormatter) -> None:
        """Write every command with the first sentence of its help, by groups."""
        widest = max(map(len, COMMANDS))
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(f"{name:<{widest}}", summary(name)) for name in commands])

    def shell_complete(self, ctx: Context, incomplete: str) -> list[CompletionItem]:
        """Return the commands and options that begin with the typed text."""
        from typer._click.shell_completion import CompletionItem

        options = super(TyperGroup, self).shell_complete(ctx, incomplete)
        names = (name for name in COMMANDS if name.startswith(incomplete))
        return [*(CompletionItem(name, help=summary(name)) for name in names), *options]


def summary(command: str) -> str:
    """Return the first paragraph of a command's docstring, without importing its module."""
    module, _, function = COMMANDS[command].partition(":")
    place = find_spec(f"flows.cli.{module}")
    assert place is not None and place.origin is not None
    tree = ast.parse(Path(place.origin).read_text(encoding="utf-8"))
    node: Any = tree
    if function:
        named = (each for each in tree.body if isinstance(each, ast.FunctionDef))
        node = next(each for each in named if each.name == function)
    return " ".join((ast.get_docstring(node) or "").partition("\n\n")[0].split())


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(version("worldpose"))
        raise typer.Exit


app = typer.Typer(
    name="worldpose",
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # help names units in brackets
)


@app.callback()
def worldpose(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Reconstruct metric 3D poses of every player from many cameras."""
    cache = find_cache_folder()
    if cache.is_lasting:
        return
    effect = "each process compiles its code again, which takes minutes"
    if cache.path is not None:
        effect = f"compiled code is kept in {cache.path}"
        os.environ.setdefault("MPLCONFIGDIR", str(cache.path / "matplotlib"))
    if not os.environ.get("NUMBA_CACHE_DIR"):
        from flows.cli.console import errors, line  # late: it takes 0.1 s

        line(
            f"warning: neither the package nor the home folder is writable: {effect}. "
            "Set NUMBA_CACHE_DIR to a folder that stays, so that it is compiled only once.",
            to=errors,
        )
