"""Commands review export, import and convert: external annotation tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.console import DEFAULT_PROJECT, JsonOption, ProjectOption, line, print_json
from flows.registering import open_match
from flows.review.descriptions import in_words
from flows.stage import Match
from worldpose.errors import UsageError
from worldpose.formats.annotations import FORMATS, Format
from worldpose.store.store import Store

MatchId = Annotated[str, typer.Argument(metavar="MATCH", help="Id of a registered match.")]
FormatOption = Annotated[str, typer.Option("--format", help=f"{', '.join(FORMATS)}.")]
AnyFormatOption = Annotated[
    str | None, typer.Option("--format", help="Format of the file; detected by default.")
]


def export_annotations(
    match: MatchId,
    out: Annotated[Path, typer.Option(help="Output folder; absent or empty.")],
    form: FormatOption = "coco",
    cameras: Annotated[
        list[str] | None,
        typer.Option("--camera", help="A static camera, or a clip; all static ones by default."),
    ] = None,
    frames: Annotated[
        list[int] | None, typer.Option("--frame", help="A match frame; repeatable.")
    ] = None,
    every: Annotated[
        int, typer.Option(min=1, help="Step between frames if no --frame is given.")
    ] = 50,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Write detections and images in the format of an annotation tool.

    Example: worldpose review export tiny-1 --format cvat --camera cam03 --out to_annotate
    """
    from flows.review.annotation_exchange import export_people

    store = Store.open(project)
    opened = open_match(store, match)
    places = _places(opened, cameras, frames, every)
    written = export_people(store, opened, places, out, _format(form))
    if as_json:
        print_json(
            {
                "annotations": str(written.annotations),
                "pictures": written.pictures,
                "people": written.people,
                "without_picture": written.unseen,
            }
        )
        return
    line(f"{written.annotations}: {written.people} people in {written.pictures} pictures")
    if written.unseen:
        line(f"{written.unseen} pictures have no file: there is no video of them")
    line(f"next: worldpose review import {match} FILE --exported {out / 'exported.json'} --who YOU")


def import_annotations(
    match: MatchId,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File of the annotation tool.")],
    exported: Annotated[Path, typer.Option(help="The file exported.json of the export.")],
    who: Annotated[
        str, typer.Option("--who", envvar="WORLDPOSE_REVIEWER", help="Name of the annotator.")
    ],
    form: AnyFormatOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Import an annotator's changes as corrections, found by comparison with the export.

    Example: worldpose review import tiny-1 out.xml --exported to_annotate/exported.json --who Ada
    """
    from flows.review.annotation_exchange import import_people

    store = Store.open(project)
    known = None if form is None else _format(form)
    changes, kept = import_people(
        store, lambda: open_match(store, match), file, exported, known, who=who
    )
    if as_json:
        print_json(
            {
                "pictures": changes.pictures,
                "boxes_passed_over": changes.boxes,
                "corrections": [each.model_dump(mode="json") for each in kept],
            }
        )
        return
    for each in kept:
        line(f"corrected: {in_words(each)} ({each.id})")
    line(f"{len(kept)} corrections from {changes.pictures} pictures")
    if changes.boxes:
        line(f"passed over: {changes.boxes} boxes of people who were there; keypoints decide")
    line(f"next: worldpose run {match}")


def convert_annotations(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="COCO, CVAT or Label Studio file.")],
    out: Annotated[Path, typer.Option(help="Output file; it must not exist.")],
    form: FormatOption = "coco",
) -> None:
    """Convert annotations to another format, for example COCO labels to CVAT, or CVAT to COCO.

    Example: worldpose review convert annotations.xml --out labels.json
    """
    from worldpose.formats.annotations import read_annotations, write_annotations

    chosen = _format(form)
    if out.exists():
        raise UsageError(
            str(out), expected="a new file", found="a file", todo="Choose another name."
        )
    pictures = read_annotations(file)
    write_annotations(out, pictures, chosen)
    people = sum(len(picture.people) for picture in pictures)
    line(f"{out}: {people} people in {len(pictures)} pictures")


def _format(name: str) -> Format:
    for form in FORMATS:
        if form == name:
            return form
    raise UsageError(
        f"--format {name}",
        expected=" or ".join(FORMATS),
        found=repr(name),
        todo="Name the format with --format.",
    )


def _places(
    match: Match, cameras: list[str] | None, frames: list[int] | None, every: int
) -> list[tuple[str, int]]:
    """Return camera and frame of each image: of a clip's own camera, in that clip alone.

    Raises:
        UsageError: an unknown camera or frame.
    """
    spec = match.folder.spec
    static = [camera.id for camera in spec.static_cameras]
    moving = [clip.id for clip in spec.clips if clip.broadcast is not None]
    chosen = cameras or static
    for camera in chosen:
        if camera not in (*static, *moving):
            raise UsageError(
                f"--camera {camera}",
                expected=f"one of {', '.join((*static, *moving))}",
                found=repr(camera),
                todo="Name a static camera, or a clip for its broadcast camera.",
            )
    places = [
        (camera, frame)
        for camera in chosen
        for clip in spec.clips
        if camera in (*static, clip.id)
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
