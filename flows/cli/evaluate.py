"""Command evaluate: score joints, cameras and baseline results against a reference."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import typer

from data_contracts.evaluation import MethodScore
from flows.cli.console import errors, line, print_json, print_table
from flows.cli.options import DEFAULT_PROJECT, given_options
from worldpose.errors import UsageError

if TYPE_CHECKING:
    from flows.results.ablation import Score
    from flows.results.evaluation import Scores

TableForm = Literal["text", "csv", "latex"]


def evaluate(
    prediction: Annotated[list[str] | None, typer.Option(metavar="[NAME=]PATH")] = None,
    reference: str | None = None,
    run: str = "latest",
    stage: str | None = None,
    match_in: Annotated[str | None, typer.Option(metavar="CAMERA")] = None,
    fps: Annotated[float | None, typer.Option(min=0.001)] = None,
    ablation: Annotated[int, typer.Option(metavar="SEEDS", min=0)] = 0,
    method: Annotated[list[str] | None, typer.Option(metavar="NAME=PATH")] = None,
    body: str | None = None,
    markers: Path | None = None,
    first_frame: int | None = None,
    method_fps: Annotated[list[str] | None, typer.Option(metavar="NAME=FPS")] = None,
    table: TableForm = "text",
    picture: Path | None = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Score joints and cameras against a reference; definitions in docs/reference/metrics.md.

    Example: worldpose evaluate --prediction tiny-1 --reference matches/tiny/reference

    Options:
        prediction: A joints file, a folder with joints.npz and cameras/, a match of the
            project, or a challenge submission. Joints of a match are those of the body model, as by
            `worldpose export --definition body`. With a data set, a folder of the same layout; may
            be given more than once, as NAME=FOLDER, for one table.
        reference: A joints file, a folder with joints.npz, cameras/ or both, a .c3d or .trc, or a
            .csv of positions of a provider (a table of kloppy); true poses in the layout of a
            submission for one. Or a data set with poses/ and cameras/, such as a release.
        match_in: Match whole tracks by their boxes in this camera of the reference, as the
            paper does; by distance by default.
        fps: Frames per second; the match's by default.
        ablation: Simulate N trials of each kind and print the paper's ablation instead, by our
            method and by the paper's own (worldpose/reference_method; needs torch).
        method: Score another method's result (docs/how-to/baselines.md) instead of
            --prediction; may be given more than once for one table.
        body: Body model of poses whose files name none; for --method, the open body by default.
        markers: YAML file that maps markers of a reference to joints.
        first_frame: Match frame of the methods' first image, or of the first row of positions.
        method_fps: Frames per second of a method's input video, if not the clip's.
        table: Table of methods: text, csv or latex.
        picture: With a data set, a PNG of each method's people in the camera and from the side.
    """
    given = given_options(evaluate, locals())
    allowed: tuple[str, ...]
    if ablation:
        _require_effect("--ablation", given, ())
        print_ablation(ablation)
        return
    if reference is not None and prediction and not method:
        from worldpose.dataset.benchmark import is_data_set, score_folders

        if len(prediction) > 1 or is_data_set(Path(reference)):
            allowed = ("--body", "--match-in", "--fps", "--table", "--picture")
            _require_effect("clips of a data set", given, allowed)
            folders = named_folders(prediction)
            results, sample = score_folders(
                Path(reference), folders, body=body, match_in=match_in, fps=fps
            )
            if picture is not None:
                from worldpose.formats.files import whole_file
                from worldpose.reports.data_set import plot_methods

                with whole_file(picture) as draft:
                    draft.write_bytes(plot_methods(sample))
            for place, note in (each for score in results for each in score.notes.items()):
                line(f"{place}: {note}", to=errors)
            print_methods(results, table)
            return
    if method and reference is not None and not prediction and picture is None:
        from flows.results.baselines import score_methods

        allowed = ("--match-in", "--body", "--first-frame", "--fps", "--method-fps", "--table")
        _require_effect("--method", given, allowed)
        found = score_methods(
            method,
            reference,
            match_in=match_in,
            body=body,
            first_frame=first_frame,
            fps=fps,
            seen_fps=named_rates(method_fps or ()),
        )
        print_methods(found, table)
        return
    if not prediction or reference is None or picture is not None or method:
        raise UsageError(
            "worldpose evaluate",
            expected="--prediction or --method, and --reference; --picture only with a data set",
            found="others",
            todo="Name prediction and ground truth, or use --ablation 10.",
        )
    from worldpose.formats.challenge import is_submission

    if is_submission(Path(prediction[0])) and is_submission(Path(reference)):
        _require_effect("submissions", given, ())
        _print_challenge(Path(prediction[0]), Path(reference))
        return
    from flows.results.evaluation import TABLES, Reading, is_of_files, score

    of_reference = {**dict.fromkeys(TABLES, "--first-frame"), ".c3d": "--markers"}
    of_reference[".trc"] = "--markers"
    allowed = ("--match-in", "--fps", of_reference.get(Path(reference).suffix.lower(), ""))
    of_run = () if is_of_files(prediction[0]) else ("--run", "--stage")
    _require_effect("this prediction and reference", given, (*allowed, *of_run))
    scores = score(
        prediction[0],
        reference,
        project,
        run_id=run,
        stage=stage,
        fps=fps,
        match_in=match_in,
        reading=Reading(markers, first_frame),
    )
    if scores.age:
        line(scores.age, to=errors)
    _print_scores(scores)


def _require_effect(kind: str, given: Sequence[str], allowed: Sequence[str]) -> None:
    """Raise UsageError if an option is given that has no effect."""
    always = ["--project", "--ablation"]
    if kind != "--ablation":
        always = ["--project", "--prediction", "--reference", "--method"]
    idle = [name for name in given if name not in (*allowed, *always)]
    if idle:
        raise UsageError(
            f"worldpose evaluate {' '.join(idle)}",
            expected=f"with {kind}, {', '.join(filter(None, allowed)) or 'none of these options'}",
            found=f"{', '.join(idle)}, which has no effect",
            todo="Leave it out.",
        )


def named_folders(given: Sequence[str]) -> dict[str, Path]:
    """Parse [NAME=]FOLDER arguments; raise UsageError if a folder is absent or a name is twice."""
    folders: dict[str, Path] = {}
    for item in given:
        name, equals, path = item.partition("=")
        if not equals or Path(item).exists():
            name, path = Path(item).resolve().name, item
        if name in folders or not Path(path).is_dir():
            found = f"{name} twice" if name in folders else f"no folder {path}"
            todo = "Give each method a name and its folder, such as --prediction glamr=results."
            expected = "NAME=FOLDER of a method's clips, each name once"
            raise UsageError(f"--prediction {item}", expected=expected, found=found, todo=todo)
        folders[name] = Path(path)
    return folders


def _print_challenge(prediction: Path, reference: Path) -> None:
    from worldpose.evaluation.challenge import ALL, score_submission
    from worldpose.formats.challenge import submission_clips

    found = {name: each.row() for name, each in score_submission(prediction, reference).items()}
    if unknown := [clip for clip in submission_clips(prediction) if clip not in found]:
        line(f"not scored, as the reference lacks them: {', '.join(unknown)}", to=errors)
    print_json({**found[ALL], "clips": {name: each for name, each in found.items() if name != ALL}})
    rows = [(name, *(f"{value:.4g}" for value in row.values())) for name, row in found.items()]
    print_table("", ("clip", *(f">{name}" for name in found[ALL])), rows)


def _print_scores(scores: Scores) -> None:
    from worldpose.reports.run_report import score_rows

    alignment = scores.alignment
    metrics = scores.evaluation.model_dump(exclude_none=True)
    if alignment is not None:
        metrics["reference_offset_s"] = alignment.offset
        metrics["reference_residual_m"] = alignment.residual
    if scores.notes:
        metrics["notes"] = scores.notes
    print_json(metrics)
    if alignment is not None:
        line(
            f"the reference's clock is {alignment.offset:.4f} s at match frame 0; after a rigid "
            f"alignment, joints are {1000.0 * alignment.residual:.1f} mm apart (root mean square)"
        )
    for note in scores.notes:
        line(note)
    rows = [
        (name, value, meaning)
        for name, _, value, meaning in score_rows(scores.evaluation)
        if not name.startswith("cameras.")
    ]
    print_table("against the reference", ("metric", ">value", "meaning"), rows)
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


def print_ablation(seeds: int) -> None:
    """Simulate trials and print every row's mean and standard deviation over them.

    Seeds count from 0; JSON has every trial's metrics.
    """
    from flows.results.ablation import BY_PAPER, PAPER, Score, ablation

    trials = ablation(
        range(seeds), lambda clicks, seed: line(f"{clicks}: trial {seed} done", to=errors)
    )
    names = [field.name for field in fields(Score)]
    print_json(
        {
            clicks: {
                row: {name: [getattr(trial[row], name) for trial in found] for name in names}
                for row in found[0]
            }
            for clicks, found in trials.items()
        }
    )
    columns = ("", ">G-MPJPE", ">PA-MPJPE", ">ground m", ">clicks px")
    for clicks, found in trials.items():
        for how in ("", BY_PAPER):
            names = [row for row in found[0] if row.endswith(BY_PAPER) == bool(how)]
            rows = [
                _row(each.removesuffix(how), [trial[each] for trial in found]) for each in names
            ]
            print_table(f"{clicks}{how}: {seeds} trials, mm, mean ± spread", columns, rows)
    published = [(name, f"{g:.1f}", f"{pa:.1f}") for name, (g, pa) in PAPER.items()]
    print_table("the paper's trial, real people, mm", ("", ">G-MPJPE", ">PA-MPJPE"), published)


def _row(name: str, scores: list[Score]) -> str:
    g, pa, ground, marking = (
        np.array([getattr(score, figure) for score in scores])
        for figure in ("g_mpjpe_mm", "pa_mpjpe_mm", "ground_error_m", "marking_error_px")
    )
    return (
        f"{name}\t{g.mean():.1f} ± {g.std():.1f}\t{pa.mean():.1f} ± {pa.std():.1f}\t"
        f"{ground.mean():.3f}\t{marking.mean():.2f}"
    )


def named_rates(given: Sequence[str]) -> dict[str, float]:
    """Parse NAME=FPS arguments into numbers by name."""
    rates = {}
    for item in given:
        name, _, text = item.partition("=")
        try:
            rates[name] = float(text)
        except ValueError:
            rates[name] = 0.0
        if not 0.0 < rates[name] < math.inf:
            raise UsageError(
                f"--method-fps {item}",
                expected="NAME=FPS, such as gvhmr=30",
                found=repr(text),
                todo="Give the frames per second of the method's input video.",
            )
    return rates


def print_methods(scores: Sequence[MethodScore], form: TableForm) -> None:
    """Print scores of methods as text, CSV or LaTeX, or in full as JSON."""
    from flows.results import baselines

    rows = [score.model_dump(mode="json", exclude_none=True) for score in scores]
    print_json({"methods": rows, "table": [list(row) for row in baselines.table_rows(scores)]})
    if form == "text":
        # Brackets would be parsed as markup.
        titles = (
            f">{title.replace('[', '').replace(']', '')}" for title in baselines.COLUMNS.values()
        )
        print_table("", (*baselines.table_columns(scores), *titles), baselines.table_rows(scores))
    else:
        line((baselines.table_csv if form == "csv" else baselines.table_latex)(scores).rstrip())
