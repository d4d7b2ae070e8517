"""Commands that bring results out: export, evaluate, report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import (
    DEFAULT_PROJECT,
    JsonOption,
    MatchArgument,
    ProjectOption,
    RunOption,
    output,
    print_json,
    table,
)
from worldpose.errors import UsageError
from worldpose.store import Store, open_run


def export(
    match: MatchArgument,
    form: Annotated[str, typer.Option("--format", help="joints or coco.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write into.")],
    run: RunOption = "latest",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Write a run's results as files that other tools read.

    Example: worldpose export tiny --format joints --out exported
    """
    from flows.registering import find_match
    from flows.release import EXPORTS

    if form not in EXPORTS:
        raise UsageError(
            f"--format {form}",
            expected=f"one of {', '.join(EXPORTS)}",
            found=repr(form),
            todo="Choose one of these.",
        )
    known = find_match(Store.open(project), match)
    written = EXPORTS[form](open_run(project, known.match_id, run), known.folder.spec, out)
    if as_json:
        print_json({"match": known.match_id, "files": [str(path) for path in written]})
    else:
        for path in written:
            output.print(f"wrote {path}", highlight=False)


def evaluate(
    prediction: Annotated[
        str, typer.Option("--prediction", help="A joints file, or a match of the project.")
    ],
    reference: Annotated[
        str, typer.Option("--reference", help="A joints file, or a folder with joints.npz.")
    ],
    run: RunOption = "latest",
    stage: Annotated[
        str | None, typer.Option("--stage", help="Score this stage's joints; the best by default.")
    ] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Score joints against a reference; definitions in docs/metrics.md.

    Example: worldpose evaluate --prediction tiny --reference matches/tiny/reference
    """
    from flows.evaluation import load_prediction, load_reference
    from worldpose.evaluation import evaluate_joints
    from worldpose.release.report import MEANINGS

    estimated = load_prediction(prediction, project, run_id=run, stage=stage)
    scores, people = evaluate_joints(estimated, load_reference(reference))
    figures = scores.model_dump(exclude_none=True)
    if as_json:
        print_json(figures)
        return
    shown = table("against the reference", "figure", ">value", "meaning")
    for name, value in figures.items():
        shown.add_row(name, f"{value:.4g}", MEANINGS[name][2])
    output.print(shown)
    shown = table("", "person", ">frames", ">found", ">mpjpe_mm", ">pcp3d")
    for person in people:
        shown.add_row(
            str(person.person_id),
            str(person.frames),
            *(
                "-" if value is None else f"{value:.4g}"
                for value in (person.coverage, person.mpjpe_mm, person.pcp3d)
            ),
        )
    output.print(shown)


def report(
    match: MatchArgument,
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("report.html"),
    reference: Annotated[
        str | None,
        typer.Option("--reference", help="Truth; reference/ of the match folder by default."),
    ] = None,
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
    write_report(store, known, out, run_id=run, reference=reference)
    if as_json:
        print_json({"match": known.match_id, "report": str(out.resolve())})
    else:
        output.print(f"report:  {out.resolve()}", highlight=False)
        output.print(f"results: {store.url}/results/{known.match_id}", highlight=False)


def add_to(app: typer.Typer) -> None:
    """Register these commands."""
    for command in (export, evaluate, report):
        app.command()(command)
