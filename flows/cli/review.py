"""List pending reviews, decide on them, and correct results."""

from __future__ import annotations

import logging
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import typer
from pydantic import TypeAdapter, ValidationError

from data_contracts.review import Edit
from flows.cli import console, options, review_exchange
from flows.cli.console import DEFAULT_PROJECT, JsonOption, ProjectOption
from flows.orchestration.prefect_environment import has_server
from flows.registering import find_registration, open_for_review, open_match
from flows.review import verdicts
from flows.review.corrections import objections_of
from flows.review.descriptions import describe_corrections, in_words, review_json, when
from flows.review.metric_words import metric_words, reason_words
from flows.review.verdicts import Review, reviews_of
from flows.run_record import latest_run
from flows.stage import Match
from worldpose.errors import InputError, WorldposeError
from worldpose.store.store import Run, Store

commands = typer.Typer(name="review", help=__doc__, no_args_is_help=True, rich_markup_mode=None)

MatchId = Annotated[str, typer.Argument(metavar="MATCH", help="Id of a registered match.")]
Requests = Annotated[
    list[str] | None,
    typer.Argument(metavar="[REVIEW...]", help="Ids from `list`; all pending ones by default."),
]
Who = Annotated[
    str, typer.Option("--who", envvar="WORLDPOSE_REVIEWER", help="Your name; it is recorded.")
]
Why = Annotated[str, typer.Option("--why", help="Your reason; it is recorded.")]
_EDITS = typer.Option("--edits", help="JSON list of corrections; see docs/how-to/review.md.")


@commands.command("list")
def list_reviews(
    match: Annotated[str | None, typer.Argument(metavar="[MATCH]")] = None,
    everything: Annotated[bool, typer.Option("--all")] = False,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """List pending reviews of one match or of all; an unreadable match does not hide the others.

    Example: worldpose review list tiny-1

    Options:
        everything: Also list decided and superseded reviews.
    """
    store = Store.open(project)
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
    if as_json:
        console.print_json({"reviews": [review_json(each) for each in shown], "problems": problems})
    elif shown or not problems:
        _print_list(shown)
    if match and problems:
        raise typer.Exit(1)


@commands.command()
def show(
    match: MatchId,
    request: Annotated[str | None, typer.Argument(metavar="[REVIEW]")] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Show one review with its metrics, or a match's corrections and the origins of its results.

    Example: worldpose review show tiny-1 static_calibration.cam03.1f2e3d4c5b6a
    """
    store = Store.open(project)
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
        _print_review(known[request], as_json)
        return
    origins = verdicts.origins_of(store, opened, latest) if latest else {}
    refused = objections_of(Run(store, latest)) if latest else {}
    applied = [each for each in opened.corrections if each.id not in refused]
    gone = ((each, refused[each.id]) for each in opened.corrections if each.id in refused)
    stale = [*opened.stale, *gone]
    marked = {name: origin for name, origin in origins.items() if origin != "automatic"}
    if as_json:
        console.print_json(
            {
                "match": match,
                "corrections": [each.model_dump(mode="json") for each in applied],
                "stale": [each.model_dump(mode="json") | {"reason": why} for each, why in stale],
                "origins": origins,
                "damage": list(opened.journal.damage),
            }
        )
        return
    since = latest.started_at if latest else datetime.min.replace(tzinfo=UTC)
    states = [
        *((it, "applied" if it.made_at <= since else "not in a run yet") for it in applied),
        *((it, f"does not apply: {why}") for it, why in stale),
    ]
    for correction, state in states:
        console.line(f"{correction.id}  {correction.who}, {when(correction.made_at)}")
        console.line(f"  {in_words(correction)}")
        console.line(f"  {state}")
    if not states:
        console.line("no corrections")
    for name, origin in marked.items():
        console.line(f"{name}: {origin}")


@commands.command()
def approve(
    match: MatchId,
    who: Who,
    requests: Requests = None,
    why: Why = "",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Approve results; the verdict applies to their bytes, also in later runs.

    Example: worldpose review approve tiny-1 --who Ada --why "checked every overlay"
    """
    _decide("approve", match, requests, who, why, None, project, as_json)


@commands.command()
def reject(
    match: MatchId,
    who: Who,
    why: Why,
    requests: Requests = None,
    edits: Annotated[Path | None, _EDITS] = None,
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Reject results, optionally with corrections; no later stage uses rejected results.

    Example: worldpose review reject tiny-1 --who Ada --why "wrong corner" --edits edits.json
    """
    _decide("reject", match, requests, who, why, edits, project, as_json)


@commands.command()
def correct(
    match: MatchId,
    who: Who,
    edits: Annotated[Path, _EDITS],
    why: Why = "",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Correct clicks, detections or identities; the next run recomputes only what depends on them.

    Example: worldpose review correct tiny-1 --who Ada --edits edits.json
    """
    store = Store.open(project)
    said = verdicts.correct(store, open_match(store, match), _read_edits(edits), who=who, why=why)
    found = {"corrections": [each.model_dump(mode="json") for each in said]}
    console.answer(as_json, found, *describe_corrections(said), _next_command(match))


@commands.command()
def withdraw(
    match: MatchId,
    correction: Annotated[str, typer.Argument(metavar="CORRECTION")],
    who: Who,
    why: Why = "",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Withdraw a correction; the journal keeps both records.

    Example: worldpose review withdraw tiny-1 moved_point.0a1b2c3d4e5f --who Ada

    Options:
        correction: Id of the correction, from `show`.
    """
    store = Store.open(project)
    verdicts.withdraw(store, open_match(store, match), [correction], who=who, why=why)
    told = f"withdrawn: {correction}"
    console.answer(as_json, {"withdrawn": correction}, told, _next_command(match))


@commands.command()
def resume(
    match: MatchId, project: ProjectOption = DEFAULT_PROJECT, as_json: JsonOption = False
) -> None:
    """Resume the suspended runs of a deployment after all reviews are decided.

    Example: worldpose review resume tiny-1
    """
    store = Store.open(project)
    resumed = verdicts.resume(store, open_match(store, match))
    told = f"resumed {len(resumed)} runs of {match}; a serving process takes them up"
    console.answer(as_json, {"resumed": resumed}, told)


@commands.command()
def serve(
    port: options.PortOption = options.PAGES_PORT,
    host: options.HostOption = "127.0.0.1",
    names: options.NamesOption = None,
    certificate: options.CertificateOption = None,
    key: options.KeyOption = None,
    token: options.TokenOption = None,
    users: options.UsersOption = None,
    project: ProjectOption = DEFAULT_PROJECT,
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
    serve_pages(project, access, host=host, port=port, tls=tls, announce=lambda: console.line(told))


def _decide(
    verdict: Literal["approve", "reject"],
    match: str,
    requests: list[str] | None,
    who: str,
    why: str,
    edits: Path | None,
    project: str,
    as_json: bool,
) -> None:
    store = Store.open(project)
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
        as_json,
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


review_exchange.add_to(commands)


def _print_list(shown: list[Review]) -> None:
    """Print review requests, each with its state and reasons."""
    if not shown:
        console.line("nothing waits for review")
    for each in shown:
        request = each.request
        console.line(f"{request.id}  {each.state}, {request.match_id}, {when(request.created_at)}")
        for reason in request.reasons:
            console.line(f"  {reason_words(reason)}")


def _print_review(shown: Review, as_json: bool) -> None:
    """Print one review request, its verdict, and all metrics."""
    if as_json:
        console.print_json(review_json(shown))
        return
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
    console.print_table("metrics", ("metric", ">value", "unit"), _metric_rows(shown))


def _metric_rows(shown: Review) -> list[tuple[str, str, str]]:
    rows = []
    for key, value in sorted(shown.request.figures.items()):
        name, _, part = key.partition(".")
        words, unit = metric_words(name)
        rows.append((f"{words} {part}".rstrip(), f"{value:.4g}", unit))
    return rows
