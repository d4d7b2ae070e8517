"""Commands that bring results out: export, evaluate, report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.ablation import print_ablation
from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    MatchArgument,
    ProjectOption,
    RunOption,
    line,
    print_json,
    print_table,
)
from worldpose.errors import UsageError
from worldpose.store import Store, open_run

StageOption = Annotated[
    str | None, typer.Option("--stage", help="Take this stage's joints; the latest by default.")
]


def export(
    match: MatchArgument,
    forms: Annotated[
        list[str],
        typer.Option(
            "--format",
            help="joints, coco, worldpose, trc, bvh, challenge, challenge-2025, tracks, "
            "slahmr-cameras or rerun (docs/formats.md); more than one may be given.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder to write into.")],
    run: RunOption = "latest",
    stage: StageOption = None,
    release: Annotated[
        str | None,
        typer.Option("--release", metavar="NAME", help="Freeze the run under a name: manifest."),
    ] = None,
    licence: Annotated[
        Path | None,
        typer.Option("--licence", help="Text under which a release's data may be used."),
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Write a run's results as files that other tools read.

    Example: worldpose export tiny --format joints --out exported
    """
    from flows.formats import Origin
    from flows.registering import find_registration
    from flows.releasing import export as export_formats
    from flows.releasing import release as write_release

    if (release is None) != (licence is None):
        raise UsageError(
            "worldpose export",
            expected="both --release NAME and --licence FILE, or neither",
            found="one of them",
            todo="A release says under which licence its data may be used.",
        )
    store = Store.open(project)
    registration = find_registration(store, match)
    origin = Origin(open_run(project, registration.spec.match_id, run), registration, stage)
    if release is None or licence is None:
        written = export_formats(origin, forms, out)
    else:
        text = licence.read_text(encoding="utf-8").strip()
        written = write_release(store, origin, forms, out, release, text)
    if as_json:
        files = [str(path) for path in written]
        print_json({"match": registration.spec.match_id, "files": files})
    else:
        for path in written:
            line(f"wrote {path}")


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
            help="Score another method's result (docs/methods.md) instead of --prediction; may be "
            "given more than once for one table.",
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
    """Score joints and cameras against a reference; definitions in docs/metrics.md.

    Example: worldpose evaluate --prediction tiny --reference matches/tiny/reference
    """
    if ablation:
        print_ablation(ablation, as_json=as_json)
        return
    if method and reference is not None and prediction is None:
        from flows.cli.methods import named_rates, print_methods
        from flows.methods import score_methods

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
    from flows.evaluation import score
    from worldpose.release.meanings import score_rows

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
        found = scores.evaluation.model_dump(exclude_none=True)
        if laid is not None:
            found |= {"reference_offset_s": laid.offset, "reference_residual_m": laid.residual}
        print_json(found)
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
    """One row for each person or camera, where there are any."""
    if not rows:
        return
    shown = []
    for name, record in rows.items():
        values = (getattr(record, column) for column in columns)
        shown.append((name, *("-" if value is None else f"{value:.3g}" for value in values)))
    print_table("", (kind, *(f">{title}" for title in columns.values())), shown)


def report(
    match: MatchArgument,
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("report.html"),
    reference: Annotated[
        str | None,
        typer.Option("--reference", help="Truth; reference/ of the match folder by default."),
    ] = None,
    videos: Annotated[
        bool,
        typer.Option(
            "--videos/--no-videos",
            help="Write broadcast videos with what was found drawn over them, beside the page.",
        ),
    ] = True,
    run: RunOption = "latest",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Write one HTML page on a run: what was done, how good it is, what it looks like.

    Example: worldpose report tiny --out report.html
    """
    from flows.registering import find_match
    from flows.reporting import write_report

    store = Store.open(project)
    known = find_match(store, match)
    films = write_report(store, known, out, run_id=run, reference=reference, videos=videos)
    if as_json:
        written = {"report": str(out.resolve()), "videos": [str(film.resolve()) for film in films]}
        print_json({"match": known.match_id, **written})
    else:
        line(f"report:  {out.resolve()}")
        for film in films:
            line(f"video:   {film.resolve()}")
        line(f"results: {store.url}/results/{known.match_id}")


def add_to(app: typer.Typer) -> None:
    """Register these commands."""
    for command in (export, evaluate, report):
        app.command()(command)
