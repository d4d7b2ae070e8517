"""Command simulate: make a synthetic match."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress, TaskID

from flows.cli.console import answer, errors, line, print_json, print_table
from worldpose.errors import UsageError, unknown_name


def simulate(
    scenario: str,
    out: Path | None = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    duration: Annotated[float | None, typer.Option(min=0.2)] = None,
    cameras: Annotated[int | None, typer.Option(min=1)] = None,
    players: Annotated[int | None, typer.Option(min=0)] = None,
    trajectories: Path | None = None,
    mocap: Path | None = None,
    calibrated: bool = False,
    stills: bool = True,
    video: bool = True,
    render: bool = False,
    masks: bool = False,
    recordings: Path | None = None,
) -> None:
    """Make a synthetic match folder with known truth.

    Example: worldpose simulate --scenario tiny --seed 1 --out matches/tiny

    Options:
        scenario: Name of a scenario; `list` shows all.
        out: Match folder to create.
        seed: Random seed; equal seeds give equal bytes.
        duration: Duration [s].
        cameras: Number of static cameras.
        players: Number of people.
        trajectories: Tracking data (npz) that people follow.
        mocap: Motion capture (BVH) that one person performs.
        calibrated: Also write the exact static cameras.
        stills: Draw one image per static camera, about 1 s each.
        video: Render the scenario's broadcast video: 0.1 s per frame.
        render: Render videos of all cameras instead of detections.
        masks: With --render, also write each pixel's person.
        recordings: For foreign-*: folder of motion capture and tracking data (npz) to replay.
    """
    from worldpose.simulation.foreign.matches import simulate_foreign_match
    from worldpose.simulation.foreign.scenarios import FOREIGN_SCENARIOS
    from worldpose.simulation.matches import simulate_match
    from worldpose.simulation.scenarios import SCENARIOS
    from worldpose.simulation.settings import MatchOptions

    about = {name: each.about for name, each in (SCENARIOS | FOREIGN_SCENARIOS).items()}
    if scenario == "list":
        print_json({"scenarios": about})
        print_table("scenarios", ("name", "what happens"), list(about.items()))
        return
    if scenario not in about:
        todo = "List the scenarios: worldpose simulate --scenario list."
        raise unknown_name(f"--scenario {scenario}", scenario, about, todo)
    if out is None:
        raise UsageError(
            "--out", expected="a folder to create", found="none", todo="Add --out FOLDER."
        )
    if masks and not render:
        raise UsageError(
            "--masks", expected="--masks with --render", found="no --render", todo="Add --render."
        )
    options = MatchOptions(
        duration=duration,
        cameras=cameras,
        players=players,
        trajectories=trajectories,
        mocap=mocap,
        calibrated=calibrated,
        stills=stills,
        video=video,
        render=render,
        masks=masks,
    )
    if scenario in FOREIGN_SCENARIOS:
        _refuse_options(
            f"foreign scenario {scenario}",
            {
                "--trajectories": trajectories is not None,
                "--mocap": mocap is not None,
                "--render": render,
                "--players 0": players == 0,
            },
        )
        foreign = FOREIGN_SCENARIOS[scenario]
        spec = simulate_foreign_match(foreign, seed, out, options, recordings)
    else:
        _refuse_options(f"scenario {scenario}", {"--recordings": recordings is not None})
        with _show_rendering() as advance:
            spec = simulate_match(SCENARIOS[scenario], seed, out, options, advance=advance)
    about = {"match": spec.match_id, "folder": str(out)}
    answer(about, f"made match {spec.match_id} in {out}")


def _refuse_options(what: str, options: dict[str, bool]) -> None:
    """Raise UsageError for the first option that was given and does not apply."""
    for option, given in options.items():
        if given:
            raise UsageError(
                option,
                expected=f"an option of {what}",
                found=f"{option}, which it does not have",
                todo="Omit the option; docs/explanation/simulation.md describes the alternatives.",
            )


@contextmanager
def _show_rendering() -> Iterator[Callable[[str, int, int], None]]:
    """Report rendering progress: a bar for each camera, or a line when one is done."""
    with Progress(console=errors, transient=True, disable=not errors.is_terminal) as bars:
        tasks: dict[str, TaskID] = {}

        def advance(name: str, done: int, frames: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(name, total=frames)
            bars.update(tasks[name], completed=done)
            if done == frames:
                line(f"filmed {name}: {frames} frames", to=errors)

        yield advance
