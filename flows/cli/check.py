"""Command check: validate an exported data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import JsonOption, errors, line, print_json, print_table

FAULTY = 1
"""Exit code if the data set has faults."""


def check(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="An exported data set, of any of the layouts.")
    ],
    fps: Annotated[
        float | None,
        typer.Option("--fps", min=0.001, help="Frames in a second; the data set's, or 50."),
    ] = None,
    body: Annotated[
        str | None,
        typer.Option("--body", help="Body model of pose files that name none; the open body."),
    ] = None,
    pitch: Annotated[
        bool, typer.Option("--pitch/--no-pitch", help="The world is no pitch: do not judge by one.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Tell whether a data set explains itself, and which convention is broken where not.

    Example: worldpose check exported
    """
    from flows.results.checking import check as check_data_set

    tell_unstated_rate(folder, fps)
    report = check_data_set(folder, fps=fps, body=body, pitch=pitch)
    if as_json:
        print_json({**report.model_dump(mode="json"), "passed": not report.findings})
    else:
        rows = [
            (
                name,
                f"{figures.frames}",
                f"{figures.persons}",
                f"{figures.cameras}",
                f"{figures.compared}",
                _shown(figures.reprojection_median_px),
                _shown(figures.plausible_share),
            )
            for name, figures in report.clips.items()
        ]
        titles = ("frames", "people", "cameras", "compared", "reprojection px", "plausible")
        print_table("", ("clip", *(f">{title}" for title in titles)), rows)
        for finding in report.findings:
            figures = ", ".join(f"{name} {value:.4g}" for name, value in finding.figures.items())
            line(f"{finding.fault}: {finding.says} [{', '.join(finding.where)}] {figures}".rstrip())
        line(f"{len(report.findings)} findings" if report.findings else "nothing is wrong")
    if report.findings:
        raise typer.Exit(FAULTY)


def tell_unstated_rate(folder: Path, fps: float | None) -> None:
    """Print the assumed frame rate, since seconds and speeds depend on it."""
    from flows.results.checking import USUAL_FPS, stated_rates

    if None in stated_rates(folder, fps).values():
        line(f"{folder}: frames a second not stated: taken as {USUAL_FPS:g} (--fps)", to=errors)


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
