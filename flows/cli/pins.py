"""Commands pin and unpin: named runs that garbage collection keeps."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

import typer

from data_contracts.pin import Pin
from flows.cli.console import DEFAULT_PROJECT, JsonOption, ProjectOption, answer
from flows.lineage import find_run
from worldpose.errors import UsageError
from worldpose.store.paths import checked_name
from worldpose.store.runs import pin_run, unpin_run
from worldpose.store.store import Store


def pin(
    run: Annotated[str, typer.Argument(metavar="RUN", help="MATCH/NUMBER, or MATCH: its latest.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the pin, such as v1.")],
    who: Annotated[
        str, typer.Option("--who", envvar="WORLDPOSE_REVIEWER", help="Your name; it is recorded.")
    ],
    why: Annotated[str, typer.Option(help="Reason for the pin; it is recorded.")] = "",
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Name a run and keep it: gc never forgets a named run, and --run accepts the name.

    Example: worldpose pin tiny-1/0002 paper --who Ada --why "figures of the paper"
    """
    store = Store.open(project)
    record = find_run(store, run)
    kept = pin_run(
        store.blobs,
        Pin(
            match_id=record.match_id,
            name=checked_name(name),
            run_id=record.run_id,
            who=who,
            why=why,
            pinned_at=datetime.now(UTC),
        ),
    )
    _say(kept, "pinned", as_json)


def unpin(
    named: Annotated[str, typer.Argument(metavar="MATCH/NAME", help="A name given by pin.")],
    project: ProjectOption = DEFAULT_PROJECT,
    as_json: JsonOption = False,
) -> None:
    """Remove the name of a run; gc may then forget the run like any other.

    Example: worldpose unpin tiny-1/paper
    """
    match_id, slash, name = named.partition("/")
    if not (match_id and slash and name):
        raise UsageError(
            f"unpin {named}",
            expected="MATCH/NAME",
            found=repr(named),
            todo="List the names: worldpose status.",
        )
    _say(unpin_run(Store.open(project).blobs, match_id, name), "unpinned", as_json)


def _say(kept: Pin, verb: str, as_json: bool) -> None:
    told = f"{verb} run {kept.run_id} of {kept.match_id} as {kept.name}"
    answer(as_json, kept.model_dump(mode="json"), told)
