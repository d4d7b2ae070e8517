"""Command evaluate: score joints, cameras and baseline results against a reference."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.ablation import print_ablation
from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    ProjectOption,
    RunOption,
    StageOption,
    line,
    print_json,
    print_table,
)
from worldpose.errors import UsageError


def evaluate(
    prediction: Annotated[
        str | None,
        typer.Option(
            "--prediction",
            help="A joints file, a folder with joints.npz and cameras/, or a match of the project.",
        ),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            "--reference",
            help="A joints file, a folder with joints.npz, cameras/ or both, or a .c3d or .trc.",
        ),
    ] = None,
    run: RunOption = "latest",
    stage: StageOption = None,
    match_in: Annotated[
        str | None,
        typer.Option(
            "--match-in",
            metavar="CAMERA",
            help="Match whole tracks by their boxes in this camera of the reference, as the paper "
            "does; by distance by default.",
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option("--fps", min=0.001, help="Frames in a second; the match's by default."),
    ] = None,
    ablation: Annotated[
        int,
        typer.Option(
            "--ablation",
            metavar="SEEDS",
            min=0,
            help="Simulate so many penalty-box trials and print the paper's ablation instead.",
        ),
    ] = 0,
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            metavar="NAME=PATH",
            help="Score another method's result (docs/how-to/baselines.md) instead of "
            "--prediction; may be given more than once for one table.",
        ),
    ] = None,
    body: Annotated[
        str | None,
        typer.Option("--body", help="Body that methods' poses are put on; the open body."),
    ] = None,
    markers: Annotated[
        Path | None,
        typer.Option("--markers", help="YAML: which markers make which joints of a reference."),
    ] = None,
    first_frame: Annotated[
        int | None,
        typer.Option("--first-frame", help="Match frame of methods' first picture."),
    ] = None,
    method_fps: Annotated[
        list[str] | None,
        typer.Option(
            "--method-fps",
            metavar="NAME=FPS",
            help="Frames in a second of the video that a method saw, where not the clip's.",
        ),
    ] = None,
    table: Annotated[
        str, typer.Option("--table", help="Table of methods: text, csv or latex.")
    ] = "text",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Score joints and cameras against a reference; definitions in docs/reference/metrics.md.

    Example: worldpose evaluate --prediction tiny-1 --reference matches/tiny/reference
    """
    if ablation:
        print_ablation(ablation, as_json=as_json)
        return
    if method and reference is not None and prediction is None:
        from flows.cli.methods import named_rates, print_methods
        from flows.results.baselines import score_methods

        found = score_methods(
            method,
            reference,
            match_in=match_in,
            body=body,
            first_frame=first_frame,
            fps=fps,
            seen_fps=named_rates(method_fps or ()),
        )
        print_methods(found, table, as_json=as_json)
        return
    if prediction is None or reference is None:
        raise UsageError(
            "worldpose evaluate",
            expected="--prediction or --method, and --reference",
            found="others",
            todo="Name what is scored and the truth, or ask for --ablation 10.",
        )
    from flows.results.evaluation import score
    from worldpose.reports.run_report import score_rows

    scores = score(
        prediction,
        reference,
        project,
        run_id=run,
        stage=stage,
        fps=fps,
        match_in=match_in,
        marker_map=markers,
    )
    laid = scores.laid
    if as_json:
        figures = scores.evaluation.model_dump(exclude_none=True)
        if laid is not None:
            figures |= {"reference_offset_s": laid.offset, "reference_residual_m": laid.residual}
        print_json(figures)
        return
    if laid is not None:
        line(
            f"the reference's clock is {laid.offset:.4f} s at match frame 0; laid over rigidly, "
            f"joints are {1000.0 * laid.residual:.1f} mm apart (root mean square)"
        )
    rows = [
        (name, value, meaning)
        for name, _, value, meaning in score_rows(scores.evaluation)
        if not name.startswith("cameras.")
    ]
    print_table("against the reference", ("figure", ">value", "meaning"), rows)
    people = {f"{person.person_id}": person for person in scores.people}
    _print_rows("person", _PERSON_COLUMNS, people)
    cameras = {camera.camera_id: camera.errors for camera in scores.cameras}
    groups = dict(scores.evaluation.cameras or ())
    cameras |= {f"all {kind}": errors for kind, errors in groups.items() if errors is not None}
    _print_rows("camera", _CAMERA_COLUMNS, cameras)


_PERSON_COLUMNS = {
    "frames": "frames",
    "coverage": "coverage",
    "mpjpe_mm": "mpjpe mm",
    "pcp3d": "pcp3d %",
    "g_mpjpe_mm": "g-mpjpe mm",
    "pa_mpjpe_mm": "pa-mpjpe mm",
}
_CAMERA_COLUMNS = {
    "ground_error_median_m": "ground m",
    "ground_error_p95_m": "95 % m",
    "reprojection_error_median_px": "image px",
    "center_error_m": "centre m",
    "rotation_error_deg": "turn deg",
    "focal_error_percent": "focal %",
}


def _print_rows(kind: str, columns: Mapping[str, str], rows: Mapping[str, object]) -> None:
    """Print one row per person or camera, if there are any."""
    if not rows:
        return
    shown = []
    for name, record in rows.items():
        values = (getattr(record, column) for column in columns)
        shown.append((name, *("-" if value is None else f"{value:.3g}" for value in values)))
    print_table("", (kind, *(f">{title}" for title in columns.values())), shown)
