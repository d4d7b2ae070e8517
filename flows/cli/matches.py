"""Commands that make and register matches: simulate, import, ingest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    ProjectOption,
    errors,
    line,
    print_json,
    print_table,
)
from flows.registering import register
from worldpose.errors import UsageError, WorldposeError
from worldpose.ingest import import_match
from worldpose.store import Store


def simulate(
    scenario: Annotated[
        str, typer.Option("--scenario", help="Name of a scenario, or `list` to see them.")
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Match folder to make.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Same seed, same bytes.")] = 0,
    duration: Annotated[float | None, typer.Option(min=0.2, help="Length [s].")] = None,
    cameras: Annotated[int | None, typer.Option(min=1, help="Number of static cameras.")] = None,
    players: Annotated[int | None, typer.Option(min=0, help="Number of people.")] = None,
    trajectories: Annotated[
        Path | None, typer.Option(help="Tracking data (npz) that drives the people.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make a synthetic match folder with known truth.

    Example: worldpose simulate --scenario tiny --seed 1 --out matches/tiny
    """
    from worldpose.synthetic import SCENARIOS, simulate_match

    if scenario == "list":
        if as_json:
            print_json({"scenarios": {name: each.about for name, each in SCENARIOS.items()}})
            return
        rows = [(name, each.about) for name, each in SCENARIOS.items()]
        print_table("scenarios", ("name", "what happens"), rows)
        return
    if scenario not in SCENARIOS:
        raise UsageError(
            f"--scenario {scenario}",
            expected=f"one of {', '.join(SCENARIOS)}",
            found=repr(scenario),
            todo="See worldpose simulate --scenario list.",
        )
    if out is None:
        raise UsageError(
            "--out", expected="the folder to make", found="nothing", todo="Add --out FOLDER."
        )
    spec = simulate_match(
        SCENARIOS[scenario],
        seed,
        out,
        duration=duration,
        cameras=cameras,
        players=players,
        trajectories=trajectories,
    )
    if as_json:
        print_json({"match": spec.match_id, "folder": str(out)})
    else:
        line(f"made match {spec.match_id} in {out}")


def import_command(
    calibration: Annotated[
        Path,
        typer.Option(help="Cameras: Anipose, Pose2Sim or caliscope TOML, or Qualisys XML."),
    ],
    detections: Annotated[Path, typer.Option(help="COCO keypoint results, <camera>.json.")],
    fps: Annotated[float, typer.Option(help="Frames a second.")],
    out: Annotated[Path, typer.Option("--out", help="Match folder to make.")],
    match_id: Annotated[
        str | None, typer.Option(help="Id of the match; the folder's name by default.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Bring calibration and 2D poses of other tools into a match folder.

    Example: worldpose import --calibration cal.toml --detections poses --fps 25 --out matches/lab
    """
    spec = import_match(calibration, detections, fps, out, match_id=match_id)
    if as_json:
        print_json({"match": spec.match_id, "folder": str(out)})
    else:
        clip = spec.clips[0]
        line(
            f"made match {spec.match_id} in {out}: {len(spec.cameras)} cameras, frames "
            f"{clip.first_frame} to {clip.first_frame + clip.frame_count - 1}"
        )


def ingest(
    folders: Annotated[list[Path], typer.Argument(metavar="MATCH...", help="Match folders.")],
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Validate match folders and make them known to the project; doing it twice is harmless.

    Example: worldpose ingest matches/tiny
    """
    store = Store.open_or_new(project)
    rows = []
    refused: list[str] = []
    for folder in folders:
        try:
            match, changed = register(store, folder)
        except WorldposeError as failure:
            refused.append(str(failure))
            line(f"error: {failure}", to=errors)
            continue
        rows.append({"match": match.match_id, "folder": str(folder), "changed": changed})
        if not as_json:
            known = "registered" if changed else "already registered, unchanged:"
            line(f"{known} {match.match_id}")
    if as_json:
        print_json({"matches": rows, "refused": refused})
    if refused:
        raise typer.Exit(4 if rows else 1)


def add_to(app: typer.Typer) -> None:
    """Register these commands."""
    app.command()(simulate)
    app.command("import")(import_command)
    app.command()(ingest)
