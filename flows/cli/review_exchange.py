"""Commands review export, import and convert: external annotation tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import DEFAULT_PROJECT, JsonOption, ProjectOption, answer, line
from flows.registering import open_match
from flows.review.descriptions import describe_corrections
from flows.stage import Match
from worldpose.errors import UsageError, unknown_name
from worldpose.formats.annotations import Format
from worldpose.store.store import Store

MatchId = Annotated[str, typer.Argument(metavar="MATCH", help="Id of a registered match.")]
FormatOption = Annotated[Format, typer.Option("--format", help="Format of the annotation tool.")]
AnyFormatOption = Annotated[
    Format | None, typer.Option("--format", help="Format of the file; detected by default.")
]


def export_annotations(
    match: MatchId,
    out: Annotated[Path, typer.Option()],
    form: FormatOption = "coco",
    cameras: Annotated[list[str] | None, typer.Option("--camera")] = None,
    frames: Annotated[list[int] | None, typer.Option("--frame")] = None,
    every: Annotated[int, typer.Option(min=1)] = 50,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Write detections and images in the format of an annotation tool.

    Example: worldpose review export tiny-1 --format cvat --camera cam03 --out to_annotate

    Options:
        out: Output folder; absent or empty.
        cameras: A static camera, or a clip; all static ones by default.
        frames: A match frame; repeatable.
        every: Step between frames if no --frame is given.
    """
    from flows.review.annotation_exchange import export_people

    store = Store.open(project)
    opened = open_match(store, match)
    places = _places(opened, cameras, frames, every)
    written = export_people(store, opened, places, out, form)
    unseen = f"{written.unseen} pictures have no file: there is no video of them"
    answer(
        as_json,
        {
            "annotations": str(written.annotations),
            "pictures": written.pictures,
            "people": written.people,
            "without_picture": written.unseen,
        },
        f"{written.annotations}: {written.people} people in {written.pictures} pictures",
        *([unseen] if written.unseen else []),
        f"next: worldpose review import {match} FILE --exported {out / 'exported.json'} --who YOU",
    )


def import_annotations(
    match: MatchId,
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    exported: Annotated[Path, typer.Option()],
    who: Annotated[str, typer.Option("--who", envvar="WORLDPOSE_REVIEWER")],
    form: AnyFormatOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Import an annotator's changes as corrections, found by comparison with the export.

    Example: worldpose review import tiny-1 out.xml --exported to_annotate/exported.json --who Ada

    Options:
        file: File of the annotation tool.
        exported: The file exported.json of the export.
        who: Name of the annotator.
    """
    from flows.review.annotation_exchange import import_people

    store = Store.open(project)
    changes, kept = import_people(
        store, lambda: open_match(store, match), file, exported, form, who=who
    )
    passed_over = f"passed over: {changes.boxes} boxes of people who were there; keypoints decide"
    answer(
        as_json,
        {
            "pictures": changes.pictures,
            "boxes_passed_over": changes.boxes,
            "corrections": [each.model_dump(mode="json") for each in kept],
        },
        *describe_corrections(kept),
        f"{len(kept)} corrections from {changes.pictures} pictures",
        *([passed_over] if changes.boxes else []),
        f"next: worldpose run {match}",
    )


def convert_annotations(
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    out: Annotated[Path, typer.Option()],
    form: FormatOption = "coco",
) -> None:
    """Convert annotations to another format, for example COCO labels to CVAT, or CVAT to COCO.

    Example: worldpose review convert annotations.xml --out labels.json

    Options:
        file: COCO, CVAT or Label Studio file.
        out: Output file; it must not exist.
    """
    from worldpose.formats.annotations import read_annotations, write_annotations

    if out.exists():
        raise UsageError(
            str(out), expected="a new file", found="a file", todo="Choose another name."
        )
    pictures = read_annotations(file)
    write_annotations(out, pictures, form)
    people = sum(len(picture.people) for picture in pictures)
    line(f"{out}: {people} people in {len(pictures)} pictures")


def _places(
    match: Match, cameras: list[str] | None, frames: list[int] | None, every: int
) -> list[tuple[str, int]]:
    """Return camera and frame of each image: of a clip's own camera, in that clip alone."""
    spec = match.folder.spec
    static = [camera.id for camera in spec.static_cameras]
    moving = [*spec.broadcast_views]
    chosen = cameras or static
    for camera in chosen:
        if camera not in (*static, *moving):
            raise unknown_name(f"--camera {camera}", camera, (*static, *moving))
    places = [
        (camera, frame)
        for camera in chosen
        for clip in spec.clips_of(camera)
        for frame in range(clip.first_frame, clip.first_frame + clip.frame_count)
        if (frame in frames if frames else (frame - clip.first_frame) % every == 0)
    ]
    if not places:
        raise UsageError(
            "--frame",
            expected="frames of a clip",
            found=", ".join(map(str, frames or [])),
            todo="Choose match frames within a clip of match.yaml.",
        )
    return places


def add_to(commands: typer.Typer) -> None:
    """Register the commands `export`, `import` and `convert`."""
    commands.command("export")(export_annotations)
    commands.command("import")(import_annotations)
    commands.command("convert")(convert_annotations)
