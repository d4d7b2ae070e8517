"""Install a body model of your own, such as SMPL."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import answer
from worldpose.body.body_file import body_path, install_body

commands = typer.Typer(name="body", help=__doc__, no_args_is_help=True, rich_markup_mode=None)


@commands.command()
def install(
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    name: str | None = None,
    body_folder: Path | None = None,
) -> None:
    """Convert your licensed SMPL file once to a safe one; nothing in it is run.

    Example: worldpose body install SMPL_NEUTRAL.pkl

    Options:
        file: SMPL's .pkl or .npz.
        name: Name of the body; from the file's name by default.
    """
    model = install_body(file, body_folder, name)
    path = body_path(model.name, body_folder)
    told = f"installed body model {model.name} as {path}"
    answer({"body_model": model.name, "file": str(path)}, told)
