"""Command synchronize: find the clock offsets of a match's cameras from the people in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from data_contracts.match import ClockOffset
from flows.cli import console
from flows.cli.options import DEFAULT_PROJECT
from flows.registering import find_match
from flows.results.clock_offsets import ClockOffsets, choose_clip, find_offsets
from flows.results.outputs import claim_file
from flows.run_record import alone_with
from flows.running import RunRequest, run_match
from flows.stage import Match
from worldpose.errors import InputError
from worldpose.store.store import Run, Store


def synchronize(
    match: str,
    clip: str | None = None,
    max_offset: Annotated[float, typer.Option(min=0.1, max=60.0)] = 2.0,
    plot: Path | None = None,
    apply: bool = False,
    workers: int | None = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Find the clock offsets of the static cameras from moving people, and propose offset_frames.

    The cameras must be calibrated, and nothing must be known of their clocks. The command computes
    the match up to the 2D poses first. The offset of the first camera that it can tell stays, and
    --apply writes the others. A clock that drifts or steps has pairs [match frame, offset].

    Example: worldpose synchronize matches/lab --plot clocks.svg --apply

    Options:
        clip: Clip whose people are compared; the longest by default.
        max_offset: Largest offset between two cameras [s].
        plot: Plot of the matches by offset to write: .svg, .pdf or .png.
        apply: Write the proposed offset_frames into match.yaml.
    """
    from worldpose.reports.drawing import draw_synchronization, require_plot

    if plot is not None:
        require_plot(plot)
    store = Store.open_or_new(project)
    with console.progress(verbose=False):
        opened = find_match(store, match)
        spec = opened.folder.spec
        chosen_clip = choose_clip(spec, clip)
        claim_file(plot, opened.match_id)
        run = compute_poses(store, opened, workers, RunRequest({}, until_stage="detection"))
    offsets = find_offsets(run, opened, chosen_clip, max_offset)
    found, rows, changed = offsets.found, offsets.rows, offsets.changed
    if plot is not None:
        draw_synchronization(found, offsets.names, plot)
    if apply and changed:
        from worldpose.ingest.writing import write_offsets

        write_offsets(opened.folder.folder, changed)
    console.print_json(
        {
            "clip": chosen_clip,
            "cameras": [row._asdict() for row in rows],
            "applied": changed if apply else {},
        }
    )
    _print(offsets, plot, applied=apply)
    if offsets.warning:
        console.line(f"warning: {offsets.warning}", to=console.errors)
    is_known = np.isfinite(found.late).all() and not offsets.warning
    raise typer.Exit(0 if is_known else 4)


def compute_poses(store: Store, match: Match, workers: int | None, *parts: RunRequest) -> Run:
    """Compute parts of the method, up to the 2D poses, with the gates of the match's other runs.

    Raises:
        InputError: another process runs the match, or results must be reviewed first.
    """
    with alone_with(store, match.match_id):
        for part in parts:
            record = run_match(store, match, replace(part, workers=workers))
    if record.waiting and any(name.startswith("detection/") for name in record.blocked):
        raise InputError(
            f"{match.match_id}: 2D poses",
            expected="all results that they need",
            found=f"{len(record.waiting)} that wait for review",
            todo=f"Decide them first: worldpose review list {match.match_id}.",
        )
    return Run(store, record)


def _offset_text(offset: ClockOffset) -> str:
    """Return an offset as in match.yaml."""
    pairs = [list(pair) for pair in offset] if isinstance(offset, tuple) else offset
    return str(pairs)


def _print(offsets: ClockOffsets, plot: Path | None, *, applied: bool) -> None:
    """Print a table of the offsets, and what to do with them."""
    changed = offsets.changed
    shown = [
        (
            row.camera,
            _offset_text(row.stated),
            "-" if row.found is None else f"{round(row.found, 2) + 0.0:.2f}",  # never -0.00
            "-" if row.std is None else f"{row.std:.2f}",
            "-" if row.found is None else _offset_text(row.proposed),
            row.reason if row.relative_to is None else f"relative to {row.relative_to}",
        )
        for row in offsets.rows
    ]
    head = ("camera", ">offset_frames", ">by the people", ">standard deviation", ">proposed", "")
    console.print_table("clock offsets of the cameras", head, shown)
    if plot is not None:
        console.line(f"wrote {plot}")
    if not changed:
        console.line("match.yaml needs no change.")
    elif applied:
        console.line(f"wrote offset_frames of {', '.join(changed)} into match.yaml")
    else:
        console.line("Add --apply to write the proposed offsets into match.yaml.")
    if offsets.has_rest:
        console.line(
            "The fraction of a frame remains; worldpose run --set "
            "triangulation.correct_clocks=true corrects it."
        )
