"""List, pull and verify checkpoints of detectors and pose nets by name."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, DownloadColumn, Progress

from data_contracts.checkpoint import Checkpoint
from flows.checkpoint_downloads import find_damage, pull, read_catalog
from flows.cli.console import answer, errors, print_json, print_table
from worldpose.detection.models import model_folder, read_pulled
from worldpose.errors import WorldposeError, unknown_name

commands = typer.Typer(name="models", help=__doc__, no_args_is_help=True, rich_markup_mode=None)

SETTING = {"detector": "detection.detector", "pose": "detection.pose"}


@commands.command(name="list")
def list_models(catalog: Path | None = None, folder: Path | None = None) -> None:
    """List the checkpoints that can be pulled, and those that are there.

    Example: worldpose models list
    """
    place = folder or model_folder()
    known = read_catalog(catalog)
    there = _read_all_pulled(place)
    for name, pulled in there.items():
        known.setdefault(name, pulled)
    rows: list[dict[str, Any]] = []
    for each in known.values():
        sizes = [file.size for file in each.files if file.size is not None]
        rows.append(
            {
                "name": each.name,
                "setting": _setting_for(each),
                "bytes": sum(sizes) if sizes else None,
                "licence": each.licence,
                "pulled": each.name in there,
                "about": each.about,
                "files": [file.model_dump(exclude_none=True) for file in each.files],
            }
        )
    print_json({"folder": str(place), "models": rows})
    columns = ("name", "setting", ">MB", "licence", "pulled", "what it is")
    shown = (
        (
            row["name"],
            row["setting"],
            f"{row['bytes'] / 1e6:.0f}" if row["bytes"] else "-",
            row["licence"],
            "yes" if row["pulled"] else "no",
            row["about"],
        )
        for row in rows
    )
    print_table(f"checkpoints; pulled ones lie in {place}", columns, shown)


def _read_all_pulled(place: Path) -> dict[str, Checkpoint]:
    """Return the pulled checkpoints by the names of their folders, sorted."""
    names = sorted(path.name for path in place.iterdir()) if place.is_dir() else []
    found = {name: read_pulled(name, place) for name in names if not name.startswith(".")}
    return {name: pulled for name, pulled in found.items() if pulled is not None}


def _setting_for(checkpoint: Checkpoint) -> str:
    return f"{SETTING[checkpoint.task]}=model:{checkpoint.name}"


@commands.command(name="pull")
def pull_model(
    name: Annotated[str, typer.Argument(metavar="NAME")],
    catalog: Path | None = None,
    folder: Path | None = None,
) -> None:
    """Download a checkpoint, check its SHA-256, and keep it in the cache.

    The next call resumes an interrupted download. No other command downloads anything.

    Example: worldpose models pull rtdetr-v2-r18

    Options:
        name: A name of `worldpose models list`.
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
    setting = _setting_for(checkpoint)
    told = f"pulled {name} into {path} ({checkpoint.licence}); use it: --set {setting}"
    answer({"name": name, "folder": str(path), "setting": setting}, told)


@commands.command(name="verify")
def verify_models(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...")] = None,
    folder: Path | None = None,
) -> None:
    """Compare pulled checkpoints with their digests, and remove damaged ones.

    Example: worldpose models verify

    Options:
        names: All pulled checkpoints by default.
    """
    place = folder or model_folder()
    there = _read_all_pulled(place)
    checked = {name: _find(name, there) for name in (names or there)}
    damaged = {name: find_damage(place / name, each) for name, each in checked.items()}
    wrong = {name: files for name, files in damaged.items() if files}
    for name in wrong:
        shutil.rmtree(place / name)
    answer(
        {"folder": str(place), "right": sorted(set(checked) - set(wrong)), "removed": wrong},
        *(f"{name}: {'removed' if name in wrong else 'all digests are right'}" for name in checked),
    )
    if wrong:
        said = "; ".join(f"{name}: {', '.join(files)}" for name, files in wrong.items())
        raise WorldposeError(
            f"{place}: expected files with their pinned SHA-256, found others ({said}). The "
            "checkpoints were removed; pull them again: worldpose models pull NAME."
        )


def _find(name: str, known: dict[str, Checkpoint]) -> Checkpoint:
    if name not in known:
        todo = "List the names: worldpose models list. --catalog FILE adds your own."
        raise unknown_name("worldpose models", name, known, todo)
    return known[name]
