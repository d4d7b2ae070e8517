"""Intake of arrivals: each complete match is registered once, and gets one run."""

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
"""Processes that end during the intake of an arrival before it is refused."""

Begin = Callable[[Match, Arrival], str]
"""Starts a run for a match, only once however often it is called; returns the run's Prefect id."""


def watch_once(state: StateFolder, inbox: Path, quiet: float) -> list[str]:
    """Scan the inbox, save its state, and return the names of complete arrivals.

    Args:
        state: holds the known state of the inbox.
        inbox: the folder.
        quiet: time without changes after which an arrival is complete [s].
    """
    with state.only_one("arrivals", wait=False) as is_held:
        ready = _looked(state, inbox, quiet) if is_held else []
    return [f"{each.name} {each.fingerprint} {each.deaths}" for _, each in ready]


def take_in(
    store: Store, state: StateFolder, inbox: Path, quiet: float, begin: Begin
) -> list[Arrival]:
    """Register every complete arrival; return all arrivals with a decision.

    A call after a kill registers nothing twice and starts no second run. An arrival whose intake
    ended the process (out of memory, a crash) is processed last at the next attempt, and is refused
    after `MAX_DEATHS`.

    Args:
        store: the project.
        state: holds the known state of the inbox.
        inbox: the folder.
        quiet: time without changes after which an arrival is complete [s].
        begin: starts a run for a match.
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
    """Register one arrival; a note written first tells the next process if this one dies."""
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
        state.write_arrival(arrival)  # an exception or a signal does not count as a death
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
    """Register one arrival, or return the reason against it; errors do not affect others."""
    try:
        missing = missing_of(entry.path)
        if missing:
            return changed(arrival, "incomplete", missing)
        match, _ = register(store, entry.path.resolve(), unfinished=True)
    except StoreError:
        raise  # the project is at fault, not the arrival
    except (RefusalError, WorldposeError) as refusal:
        return changed(arrival, "refused", str(refusal))
    except OSError as error:
        return changed(arrival, "incomplete", f"{error.filename}: {error.strerror}")
    except Exception as error:  # an unforeseen error; nothing was registered
        return changed(arrival, "refused", str(InternalError.wrapping(arrival.name, error)))
    known = {**match.folder.calibrations, **match.folder.clicked}
    unclicked = [each.id for each in match.folder.spec.static_cameras if each.id not in known]
    if unclicked:
        reason = f"to be clicked on the review pages first: {', '.join(unclicked)}"
        return changed(arrival, "taken", reason, match_id=match.match_id)
    run = begin(match, arrival)
    return changed(arrival, "taken", "", match_id=match.match_id, flow_run=run)
