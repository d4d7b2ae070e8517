"""List, pull and verify checkpoints of detectors and pose nets by name."""

from __future__ import annotations

import shutil
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, DownloadColumn, Progress

from data_contracts.checkpoint import Checkpoint
from flows.checkpoint_downloads import find_damage, pull, read_catalog
from flows.cli.console import JsonOption, errors, line, print_json, print_table
from worldpose.detection.models import model_folder, read_pulled
from worldpose.errors import UsageError, WorldposeError

commands = typer.Typer(name="models", help=__doc__, no_args_is_help=True, rich_markup_mode=None)

CatalogOption = Annotated[
    Path | None,
    typer.Option(
        "--catalog",
        envvar="WORLDPOSE_MODEL_CATALOG",
        help="YAML file with checkpoints of your own: name, address, digest.",
    ),
]
FolderOption = Annotated[
    Path | None,
    typer.Option(
        "--folder",
        help="Folder of pulled checkpoints; by default WORLDPOSE_MODEL_FOLDER, or the cache.",
    ),
]
SETTING = {"detector": "detection.detector", "pose": "detection.pose"}


@commands.command(name="list")
def list_models(
    catalog: CatalogOption = None, folder: FolderOption = None, as_json: JsonOption = False
) -> None:
    """List the checkpoints that can be pulled, and those that are there.

    Example: worldpose models list
    """
    place = folder or model_folder()
    known = read_catalog(catalog)
    for path in sorted(place.iterdir()) if place.is_dir() else ():
        pulled = None if path.name.startswith(".") else read_pulled(path.name, place)
        if pulled is not None:
            known.setdefault(pulled.name, pulled)
    if as_json:
        rows = [_describe(each, place) for each in known.values()]
        print_json({"folder": str(place), "models": rows})
        return
    columns = ("name", "setting", ">MB", "licence", "pulled", "what it is")
    print_table(
        f"checkpoints; pulled ones lie in {place}",
        columns,
        [
            (
                each.name,
                _setting_for(each),
                f"{(_size(each) or 0) / 1e6:.0f}" if _size(each) else "-",
                each.licence,
                "no" if read_pulled(each.name, place) is None else "yes",
                each.about,
            )
            for each in known.values()
        ],
    )


def _setting_for(checkpoint: Checkpoint) -> str:
    return f"{SETTING[checkpoint.task]}=model:{checkpoint.name}"


def _size(checkpoint: Checkpoint) -> int | None:
    """Return the bytes of the files whose size is known; None if none is."""
    sizes = [file.size for file in checkpoint.files if file.size is not None]
    return sum(sizes) if sizes else None


def _describe(checkpoint: Checkpoint, folder: Path) -> dict[str, object]:
    return {
        "name": checkpoint.name,
        "setting": _setting_for(checkpoint),
        "bytes": _size(checkpoint),
        "licence": checkpoint.licence,
        "pulled": read_pulled(checkpoint.name, folder) is not None,
        "about": checkpoint.about,
        "files": [file.model_dump(exclude_none=True) for file in checkpoint.files],
    }


@commands.command(name="pull")
def pull_model(
    name: Annotated[str, typer.Argument(metavar="NAME", help="A name of `worldpose models list`.")],
    catalog: CatalogOption = None,
    folder: FolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Download a checkpoint, check its SHA-256, and keep it in the cache.

    The next call resumes an interrupted download. No other command downloads anything.

    Example: worldpose models pull rtdetr-v2-r18
    """
    checkpoint = _find(name, read_catalog(catalog))
    place = folder or model_folder()
    with Progress(
        "{task.description}",
        BarColumn(),
        DownloadColumn(),
        console=errors,
        transient=True,
        disable=not errors.is_terminal,
    ) as bars:
        tasks = {file.name: bars.add_task(file.name, total=file.size) for file in checkpoint.files}

        def advance(file: str, done: int, total: int) -> None:
            bars.update(tasks[file], completed=done, total=total or None)

        path = pull(checkpoint, place, advance)
    if as_json:
        print_json({"name": name, "folder": str(path), "setting": _setting_for(checkpoint)})
        return
    line(
        f"pulled {name} into {path} ({checkpoint.licence}); "
        f"use it: --set {_setting_for(checkpoint)}"
    )


@commands.command(name="verify")
def verify_models(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="All pulled checkpoints by default."),
    ] = None,
    folder: FolderOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare pulled checkpoints with their digests, and remove damaged ones.

    Example: worldpose models verify
    """
    place = folder or model_folder()
    there = {
        path.name: pulled
        for path in (sorted(place.iterdir()) if place.is_dir() else ())
        if not path.name.startswith(".") and (pulled := read_pulled(path.name, place)) is not None
    }
    checked = {name: _find(name, there) for name in (names or there)}
    damaged = {name: find_damage(place / name, each) for name, each in checked.items()}
    wrong = {name: files for name, files in damaged.items() if files}
    for name in wrong:
        shutil.rmtree(place / name)
    if as_json:
        print_json(
            {"folder": str(place), "right": sorted(set(checked) - set(wrong)), "removed": wrong}
        )
    else:
        for name in checked:
            line(f"{name}: {'removed' if name in wrong else 'all digests are right'}")
    if wrong:
        said = "; ".join(f"{name}: {', '.join(files)}" for name, files in wrong.items())
        raise WorldposeError(
            f"{place}: expected files with their pinned SHA-256, found others ({said}). The "
            "checkpoints were removed; pull them again: worldpose models pull NAME."
        )


def _find(name: str, known: dict[str, Checkpoint]) -> Checkpoint:
    if name not in known:
        near = get_close_matches(name, known)
        raise UsageError(
            "worldpose models",
            expected=f"one of {', '.join(known) or 'no checkpoint, since none is pulled'}",
            found=repr(name) + (f"; did you mean {' or '.join(near)}?" if near else ""),
            todo="List the names: worldpose models list. --catalog FILE adds your own.",
        )
    return known[name]
