"""Taking in what has arrived: each complete match is registered once, and given one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from data_contracts.operations import Arrival
from flows.registering import register
from flows.service.inbox import Entry, RefusalError, changed, look, missing_of
from flows.service.layout import StateFolder
from flows.stage import Match
from worldpose.errors import InternalError, StoreError, WorldposeError
from worldpose.store import Store

MAX_DEATHS: Final = 2
"""Of processes that took an arrival in, after which it is refused."""

Begin = Callable[[Match, Arrival], str]
"""Gives a match its run, once however often it is called; the run's id at Prefect."""


def watch_once(state: StateFolder, inbox: Path, quiet: float) -> list[str]:
    """Look at the inbox, keep what is seen, and name the arrivals that can be taken in.

    Args:
        state: where what is known of the inbox lies.
        inbox: the folder.
        quiet: how long nothing of an arrival may have changed [s].
    """
    with state.only_one("arrivals", wait=False) as is_held:
        ready = _looked(state, inbox, quiet) if is_held else []
    return [f"{each.name} {each.fingerprint} {each.deaths}" for _, each in ready]


def take_in(
    store: Store, state: StateFolder, inbox: Path, quiet: float, begin: Begin
) -> list[Arrival]:
    """Take in every arrival that is complete; gives all that were decided on.

    Killed anywhere and called again, it registers nothing twice and begins no second run. An
    arrival whose taking in ended the process (out of memory, a crash) comes after all others the
    next time, and is refused after `MAX_DEATHS`.

    Args:
        store: the project.
        state: where what is known of the inbox lies.
        inbox: the folder.
        quiet: how long nothing of an arrival may have changed [s].
        begin: gives a match its run.
    """
    decided = []
    with state.only_one("arrivals", wait=True):
        ready = _looked(state, inbox, quiet)
        for entry, arrival in sorted(ready, key=lambda each: each[1].deaths):
            result = _take(store, state, entry, arrival, begin)
            state.write_arrival(result)
            decided.append(result)
    return decided


def _take(
    store: Store, state: StateFolder, entry: Entry, arrival: Arrival, begin: Begin
) -> Arrival:
    """Decide on one arrival; what is noted before tells the next process that this one died."""
    if arrival.deaths >= MAX_DEATHS:
        return changed(
            arrival,
            "refused",
            f"the process that took it in died {arrival.deaths} times, killed or by a crash: the "
            "system's log says which (out of memory?). It is tried again when a file of it changes",
        )
    number = arrival.deaths + 1
    state.write_arrival(
        changed(arrival, "arriving", f"being taken in, try {number}", is_begun=True)
    )
    try:
        return _decide(store, entry, arrival, begin)
    except BaseException:
        state.write_arrival(arrival)  # ended by an error or a signal, which is no death
        raise


def _looked(state: StateFolder, inbox: Path, quiet: float) -> list[tuple[Entry, Arrival]]:
    known = state.arrivals()
    seen = look(inbox, known, now=time.monotonic(), quiet=quiet)
    names = {arrival.name for _, arrival, _ in seen}
    for name, before in known.items():
        if before.state != "taken" and name not in names:
            state.forget_arrival(name)
    for _, arrival, _ in seen:
        if arrival != known.get(arrival.name):
            state.write_arrival(arrival)
    return [(entry, arrival) for entry, arrival, is_ready in seen if is_ready]


def _decide(store: Store, entry: Entry, arrival: Arrival, begin: Begin) -> Arrival:
    """Take one arrival in, or say why not; the next is taken in all the same."""
    try:
        missing = missing_of(entry.path)
        if missing:
            return changed(arrival, "incomplete", missing)
        match, _ = register(store, entry.path.resolve(), unfinished=True)
    except StoreError:
        raise  # the project's trouble is not the arrival's
    except (RefusalError, WorldposeError) as refusal:
        return changed(arrival, "refused", str(refusal))
    except OSError as error:
        return changed(arrival, "incomplete", f"{error.filename}: {error.strerror}")
    except Exception as error:  # what no reader foresaw: nothing of it was taken in
        return changed(arrival, "refused", str(InternalError.wrapping(arrival.name, error)))
    known = {**match.folder.calibrations, **match.folder.clicked}
    unclicked = [each.id for each in match.folder.spec.static_cameras if each.id not in known]
    if unclicked:
        reason = f"to be clicked on the review pages first: {', '.join(unclicked)}"
        return changed(arrival, "taken", reason, match_id=match.match_id)
    run = begin(match, arrival)
    return changed(arrival, "taken", "", match_id=match.match_id, flow_run=run)
