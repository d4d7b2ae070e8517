"""List pending reviews, decide on them, and correct results."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer
from pydantic import TypeAdapter, ValidationError

from data_contracts.review import Edit
from flows.cli import console, options
from flows.cli.options import DEFAULT_PROJECT
from flows.orchestration.prefect_environment import has_server
from flows.registering import find_registration, open_for_review, open_match
from flows.review import verdicts
from flows.review.annotation_exchange import export_people, import_people
from flows.review.corrections import objections_now
from flows.review.descriptions import describe_corrections, in_words, review_json, when
from flows.review.metric_words import metric_words, reason_words
from flows.review.verdicts import Review, reviews_of
from flows.run_record import latest_run
from flows.stage import Match
from worldpose.errors import InputError, UsageError, WorldposeError, unknown_name
from worldpose.formats.annotations import Format, read_annotations, write_annotations
from worldpose.store.store import Run, Store

commands = typer.Typer(name="review", help=__doc__, no_args_is_help=True, rich_markup_mode=None)

MatchId = Annotated[str, typer.Argument(metavar="MATCH", help="Id of a registered match.")]
Requests = Annotated[
    list[str] | None,
    typer.Argument(metavar="[REVIEW...]", help="Ids from `list`; all pending ones by default."),
]
Why = Annotated[str, typer.Option("--why", help="Your reason; it is recorded.")]
FormatOption = Annotated[Format, typer.Option("--format", help="Format of the annotation tool.")]
AnyFormatOption = Annotated[
    Format | None, typer.Option("--format", help="Format of the file; detected by default.")
]
_EDITS = typer.Option("--edits", help="JSON list of corrections; see docs/how-to/review.md.")


@commands.command("list")
def list_reviews(
    store: Store,
    match: Annotated[str | None, typer.Argument(metavar="[MATCH]")] = None,
    everything: Annotated[bool, typer.Option("--all")] = False,
) -> None:
    """List pending reviews of one match or of all; an unreadable match does not hide the others.

    Example: worldpose review list tiny-1

    Options:
        everything: Also list decided and superseded reviews.
    """
    names = [find_registration(store, match).spec.match_id] if match else store.matches()
    found: list[Review] = []
    problems: dict[str, str] = {}
    for name in names:
        try:
            opened = open_for_review(store, name)
            found += reviews_of(store, opened, latest_run(store, name))
        except (OSError, WorldposeError) as failure:
            problems[name] = str(failure)
            console.line(f"{name}: {failure}", to=console.errors)
        else:
            _tell_damage(opened)
    shown = [each for each in found if everything or each.state == "waits"]
    console.print_json({"reviews": [review_json(each) for each in shown], "problems": problems})
    if not shown and not problems:
        console.line("nothing waits for review")
    for each in shown:
        request = each.request
        console.line(f"{request.id}  {each.state}, {request.match_id}, {when(request.created_at)}")
        for reason in request.reasons:
            console.line(f"  {reason_words(reason)}")
    if match and problems:
        raise typer.Exit(1)


@commands.command()
def show(
    store: Store,
    match: MatchId,
    request: Annotated[str | None, typer.Argument(metavar="[REVIEW]")] = None,
) -> None:
    """Show one review with its metrics, or a match's corrections and the origins of its results.

    Example: worldpose review show tiny-1 static_calibration.cam03.1f2e3d4c5b6a
    """
    opened = open_match(store, match)
    _tell_damage(opened)
    latest = latest_run(store, match)
    if request is not None:
        known = {each.request.id: each for each in reviews_of(store, opened, latest)}
        if request not in known:
            raise InputError(
                f"review {request}",
                expected=f"one of {', '.join(known) or '(none)'}",
                found="no such review",
                todo=f"List them: worldpose review list {match} --all.",
            )
        _print_review(known[request])
        return
    origins = verdicts.origins_of(store, opened, latest) if latest else {}
    refused = objections_now(store, opened, latest)
    contained = verdicts.corrections_in(Run(store, latest), opened) if latest else []
    states = {each.id: "not in a run yet" for each in opened.corrections}
    states |= {each.id: "applied" for each in contained}
    applied = [each for each in opened.corrections if each.id not in refused]
    gone = ((each, refused[each.id]) for each in opened.corrections if each.id in refused)
    stale = [*opened.stale, *gone]
    marked = {name: origin for name, origin in origins.items() if origin != "automatic"}
    console.print_json(
        {
            "match": match,
            "corrections": [
                each.model_dump(mode="json") | {"state": states[each.id]} for each in applied
            ],
            "stale": [each.model_dump(mode="json") | {"reason": why} for each, why in stale],
            "origins": origins,
            "damage": list(opened.journal.damage),
        }
    )
    told = [
        *((it, states[it.id]) for it in applied),
        *((it, f"does not apply: {why}") for it, why in stale),
    ]
    for correction, state in told:
        console.line(f"{correction.id}  {correction.who}, {when(correction.made_at)}")
        console.line(f"  {in_words(correction)}")
        console.line(f"  {state}")
    if not told:
        console.line("no corrections")
    for name, origin in marked.items():
        console.line(f"{name}: {origin}")


@commands.command()
def approve(
    store: Store, match: MatchId, who: str, requests: Requests = None, why: Why = ""
) -> None:
    """Approve results; the verdict applies to their bytes, also in later runs.

    Example: worldpose review approve tiny-1 --who Ada --why "checked every overlay"
    """
    _decide(store, "approve", match, requests, who, why)


@commands.command()
def reject(
    store: Store,
    match: MatchId,
    who: str,
    why: Why,
    requests: Requests = None,
    edits: Annotated[Path | None, _EDITS] = None,
) -> None:
    """Reject results, optionally with corrections; no later stage uses rejected results.

    Example: worldpose review reject tiny-1 --who Ada --why "wrong corner" --edits edits.json
    """
    _decide(store, "reject", match, requests, who, why, edits)


@commands.command()
def correct(
    store: Store, match: MatchId, who: str, edits: Annotated[Path, _EDITS], why: Why = ""
) -> None:
    """Correct clicks, detections or identities; the next run recomputes only what depends on them.

    Example: worldpose review correct tiny-1 --who Ada --edits edits.json
    """
    said = verdicts.correct(store, open_match(store, match), _read_edits(edits), who=who, why=why)
    found = {"corrections": [each.model_dump(mode="json") for each in said]}
    console.answer(found, *describe_corrections(said), _next_command(match))


@commands.command()
def withdraw(
    store: Store,
    match: MatchId,
    correction: Annotated[str, typer.Argument(metavar="CORRECTION")],
    who: str,
    why: Why = "",
) -> None:
    """Withdraw a correction; the journal keeps both records.

    Example: worldpose review withdraw tiny-1 moved_point.0a1b2c3d4e5f --who Ada

    Options:
        correction: Id of the correction, from `show`.
    """
    verdicts.withdraw(store, open_match(store, match), [correction], who=who, why=why)
    told = f"withdrawn: {correction}"
    console.answer({"withdrawn": correction}, told, _next_command(match))


@commands.command()
def resume(store: Store, match: MatchId) -> None:
    """Resume the suspended runs of a deployment after all reviews are decided.

    Example: worldpose review resume tiny-1
    """
    resumed = verdicts.resume(store, open_match(store, match))
    told = f"resumed {len(resumed)} runs of {match}; a serving process takes them up"
    console.answer({"resumed": resumed}, told)


@commands.command()
def serve(
    port: int = options.PAGES_PORT,
    host: str = "127.0.0.1",
    names: list[str] | None = None,
    certificate: Path | None = None,
    key: Path | None = None,
    token: str | None = None,
    users: Path | None = None,
    project: str = DEFAULT_PROJECT,
) -> None:
    """Serve the review pages to browsers until interrupted.

    Example: worldpose review serve --port 8571
    """
    # Imported here: the server takes half a second to import, and no other command needs it.
    from flows.web.access import access_for
    from flows.web.app import address
    from flows.web.app import serve as serve_pages

    tls = options.certificate_and_key(certificate, key)
    access = access_for(host, token=token, names=names or (), secure=tls is not None, users=users)
    logging.basicConfig(format="%(asctime)s  %(message)s", level=logging.WARNING)
    logging.getLogger("worldpose.pages").setLevel(logging.INFO)
    # A token chosen by the operator is not printed (the output can go to a log), nor one that
    # admits no user.
    where = address(access, host, port)
    is_shown = token is None and users is None
    shown = where if is_shown else where.partition("#")[0]
    told = f"review pages of {Store.open(project).url}: {shown}"
    say = partial(console.answer, {"pages": shown}, told)
    serve_pages(project, access, host=host, port=port, tls=tls, announce=say)


def _decide(
    store: Store,
    verdict: Literal["approve", "reject"],
    match: str,
    requests: list[str] | None,
    who: str,
    why: str,
    edits: Path | None = None,
) -> None:
    ids, corrections = verdicts.decide(
        store,
        open_match(store, match),
        requests or (),
        verdict,
        who=who,
        why=why,
        edits=_read_edits(edits) if edits else (),
    )
    said = [each.model_dump(mode="json") for each in corrections]
    console.answer(
        {"verdict": verdict, "reviews": ids, "corrections": said},
        *(f"{verdict}: {name}" for name in ids),
        *describe_corrections(corrections),
        _next_command(match),
    )


def _read_edits(file: Path) -> list[Edit]:
    try:
        return TypeAdapter(list[Edit]).validate_json(file.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{file}: {place}" if place else str(file),
            expected="a JSON list of corrections",
            found=first["msg"],
            todo="See docs/how-to/review.md and docs/schemas/correction.schema.json.",
        ) from None


def _next_command(match: str) -> str:
    resumes = f"; a suspended run: worldpose review resume {match}" if has_server() else ""
    return f"next: worldpose run {match}{resumes}"


def _tell_damage(match: Match) -> None:
    for text in match.journal.damage:
        console.line(f"warning: {text}", to=console.errors)


@commands.command("export")
def export_annotations(
    store: Store,
    match: MatchId,
    out: Path,
    form: FormatOption = "coco",
    cameras: Annotated[list[str] | None, typer.Option("--camera")] = None,
    frames: Annotated[list[int] | None, typer.Option("--frame")] = None,
    every: Annotated[int, typer.Option(min=1)] = 50,
) -> None:
    """Write detections and images in the format of an annotation tool.

    Example: worldpose review export tiny-1 --format cvat --camera cam03 --out to_annotate

    Options:
        out: Output folder; absent or empty.
        cameras: A static camera, or a clip; all static ones by default.
        frames: A match frame; repeatable.
        every: Step between frames if no --frame is given.
    """
    opened = open_match(store, match)
    places = _places(opened, cameras, frames, every)
    written = export_people(store, opened, places, out, form)
    unseen = f"{written.unseen} pictures have no file: there is no video of them"
    console.answer(
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


@commands.command("import")
def import_annotations(
    store: Store,
    match: MatchId,
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    exported: Path,
    who: Annotated[str, typer.Option(envvar="WORLDPOSE_REVIEWER")],
    form: AnyFormatOption = None,
) -> None:
    """Import an annotator's changes as corrections, found by comparison with the export.

    Example: worldpose review import tiny-1 out.xml --exported to_annotate/exported.json --who Ada

    Options:
        file: File of the annotation tool.
        exported: The file exported.json of the export.
        who: Name of the annotator.
    """
    changes, kept = import_people(
        store, lambda: open_match(store, match), file, exported, form, who=who
    )
    passed_over = f"passed over: {changes.boxes} boxes of people who were there; keypoints decide"
    console.answer(
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


@commands.command("convert")
def convert_annotations(
    file: Annotated[Path, typer.Argument(metavar="FILE")], out: Path, form: FormatOption = "coco"
) -> None:
    """Convert annotations to another format, for example COCO labels to CVAT, or CVAT to COCO.

    Example: worldpose review convert annotations.xml --out labels.json

    Options:
        file: COCO, CVAT or Label Studio file.
        out: Output file; it must not exist.
    """
    if out.exists():
        raise UsageError(str(out), "a new file", "a file", "Choose another name.")
    pictures = read_annotations(file)
    write_annotations(out, pictures, form)
    people = sum(len(picture.people) for picture in pictures)
    told = f"{out}: {people} people in {len(pictures)} pictures"
    console.answer({"annotations": str(out), "pictures": len(pictures), "people": people}, told)


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


def _print_review(shown: Review) -> None:
    """Print one review request, its verdict, and all metrics."""
    console.print_json(review_json(shown))
    request, decision = shown.request, shown.decision
    console.line(f"{request.id}: {shown.state}")
    console.line(f"  {shown.question}")
    for reason in request.reasons:
        console.line(f"  because {reason_words(reason)}")
    if decision is not None:
        console.line(f"  {decision.verdict} by {decision.who}, {when(decision.decided_at)}")
        console.line(f"  {decision.why or '(no reason given)'}")
    for unit, key in request.keys.items():
        console.line(f"  {unit} {key}, run {request.run_id}")
    rows = []
    for key, value in sorted(request.figures.items()):
        name, _, part = key.partition(".")
        words, unit = metric_words(name)
        rows.append((f"{words} {part}".rstrip(), f"{value:.4g}", unit))
    console.print_table("metrics", ("metric", ">value", "unit"), rows)
