"""Corrections of a match: recording, withdrawing, and applying them to its folder's content."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from weakref import WeakKeyDictionary

from data_contracts.match import Registration
from data_contracts.review import Correction, Edit, MovedPoint, NamedTrack, RedrawnMarking
from data_contracts.run import RunRecord
from flows.layers import add_venue, read_layers
from flows.review.detections import objections_in, replay_objections, require_seen
from flows.review.edit_conflicts import StaleEditError
from flows.review.identities import identity_objections, lost_names, once, require_fitting
from flows.stage import Match
from worldpose.errors import InputError, StoreError
from worldpose.ingest.match_folder import MatchFolder
from worldpose.review.clicks import Replay, add_previous_value, current_value, replay_corrections
from worldpose.review.detections import DETECTION_EDITS
from worldpose.review.identities import IDENTITY_EDITS
from worldpose.review.journal import MOST_KEPT, Journal, append, read_journal
from worldpose.store.store import Run, Store


def owner_of(edit: Edit) -> str:
    """Return the camera or clip of an edit, the unit of the results that it corrects."""
    return str(getattr(edit, "camera", None) or getattr(edit, "clip", ""))


def corrected_match(store: Store, folder: MatchFolder, registration: Registration) -> Match:
    """Return the match as layers of settings and corrections complete it; no file changes."""
    layers = read_layers(store, registration.spec)
    folder = add_venue(folder, layers)
    journal = read_journal(store, registration.spec.match_id)
    replay = _replay_corrections(store, folder, tuple(journal.standing.values()))
    return Match(replay.folder, registration, journal, replay.applied, replay.stale, layers)


_REPLAYED: WeakKeyDictionary[
    Store, dict[str, tuple[MatchFolder, tuple[Correction, ...], Replay]]
] = WeakKeyDictionary()
"""Match to its folder as it was read, the corrections in force, and the replay result."""


def _replay_corrections(
    store: Store, folder: MatchFolder, standing: tuple[Correction, ...]
) -> Replay:
    """Replay all corrections; corrections already replayed on the same folder are not repeated."""
    known = _REPLAYED.setdefault(store, {})
    before, done, replay = known.pop(folder.spec.match_id, (folder, (), Replay(folder)))
    if before != folder or standing[: len(done)] != done:
        done, replay = (), Replay(folder)
    rest = standing[len(done) :]
    if rest:
        more = replay_corrections(replay.folder, rest)
        replay = Replay(more.folder, replay.applied + more.applied, replay.stale + more.stale)
    known[folder.spec.match_id] = (folder, standing, replay)
    while len(known) > MOST_KEPT:
        known.pop(next(iter(known)), None)
    return replay


def objections_of(run: Run) -> dict[str, str]:
    """Return why corrections in force do not apply to the results of a run, by their ids."""
    standing = read_journal(run.store, run.record.match_id).standing
    found = {name: why for name, why in lost_names(run).items() if name in standing}
    said = {name: each.edit.model_dump(mode="json") for name, each in standing.items()}
    for unit, figures in run.record.figures.items():
        if unit not in run or not figures.get("corrections_refused"):
            continue
        place = (run.record.match_id, *unit.split("/", 1), run.record.results[unit])
        if not run.store.has(*place):  # withdrawn
            continue
        sources = run.manifest(unit).recipe.sources
        taken = sources.get("identities") or sources["edits"]
        assert isinstance(taken, list)  # corrections as JSON
        for edit, why in zip(taken, objections_in(run, unit, taken), strict=True):
            name = next((it for it in said if said[it] == edit), "")
            said.pop(name, None)  # of two that are equal, the second can be refused
            found |= {name: why} if name and why else {}
    return found


def objections_now(store: Store, match: Match, latest: RunRecord | None) -> dict[str, str]:
    """Return why corrections in force do not apply to the latest run, or to what pages show."""
    if latest is None:
        return {}
    found = objections_of(Run(store, latest))
    made: dict[tuple[str, bool], list[Correction]] = {}
    for each in match.corrections:
        if isinstance(each.edit, (*IDENTITY_EDITS, *DETECTION_EDITS)):
            key = owner_of(each.edit), isinstance(each.edit, IDENTITY_EDITS)
            made.setdefault(key, []).append(each)
    for (owner, is_clip), corrections in made.items():
        replay = identity_objections if is_clip else replay_objections
        try:
            told = once(
                (store, f"{match.match_id}/{owner} {is_clip}", 1000),
                (latest.results, [each.id for each in corrections]),
                lambda: replay(store, match, owner),  # noqa: B023
            )
        except (InputError, StoreError):  # nothing is replayed before the next run: it says why
            continue
        for number, why in told.items():
            each = corrections[number]
            if not isinstance(each.edit, NamedTrack):
                found |= {each.id: why} if why else {}
            elif why is None:  # a correction since the run made the person
                found.pop(each.id, None)
    return found


def new_corrections(
    store: Store,
    match: Match,
    journal: Journal,
    edits: Sequence[Edit],
    *,
    who: str,
    note: str,
    results: Mapping[str, str],
    ids: Sequence[str] = (),
) -> list[Correction]:
    """Turn edits, in the order of application, into corrections, each based on those before it.

    The match is as it was opened, the journal as it is now; `results` are those that the reviewer
    saw. `ids` has one id per edit; empty = new ids. StaleEditError if the edited value differs from
    the edit's `was`, or from the results; InputError if an edit does not apply, because of its
    target or of another person's edit in between. No edit is kept then.
    """
    standing = tuple(journal.standing.values())
    if standing != tuple(match.journal.standing.values()):
        raise InputError(
            f"corrections of {match.match_id}",
            expected="the corrections that existed when this edit began",
            found="others, which were made since",
            todo="Read them with `worldpose review show`, and repeat the correction.",
        )
    if results:  # before the first run there is nothing to compare with: the run tells
        edits = require_fitting(store, match, edits)
        require_seen(store, match, edits)
    folder, said = match.folder, []
    for number, given in enumerate(edits):
        edit = add_previous_value(folder, given)
        _require_unchanged(folder, standing, edit)
        correction = Correction(
            id=ids[number] if ids else f"{edit.kind}.{uuid.uuid4().hex[:12]}",
            match_id=match.match_id,
            edit=edit,
            who=who,
            made_at=datetime.now(UTC),
            based_on={
                n: key for n, key in results.items() if n.partition("/")[2] == owner_of(edit)
            },
            note=note or None,
        )
        replay = replay_corrections(folder, [correction])
        is_of_results = isinstance(edit, (*IDENTITY_EDITS, *DETECTION_EDITS))
        if replay.stale or (replay.folder == folder and not is_of_results):
            raise InputError(
                f"edit {number + 1} of {len(edits)}, {edit.kind}",
                expected="one that applies",
                found=replay.stale[0][1] if replay.stale else "one that changes nothing",
                todo="Fix this edit; none of the edits was recorded.",
            )
        folder = replay.folder
        said.append(correction)
    return said


def keep_edits(
    store: Store, open_match: Callable[[], Match], given: Mapping[str, Edit], *, who: str, note: str
) -> list[Correction]:
    """Record edits as corrections in the journal, all or none; durable on return.

    `open_match` returns the match with its current journal; `given` has the edits by id in the
    order of application. An id that is already recorded counts as resent, and is kept once. Errors
    are as of `new_corrections`.
    """
    while True:
        match = open_match()
        said = match.journal.corrections
        fresh = {name: edit for name, edit in given.items() if name not in said}
        runs = store.runs(match.match_id)
        corrections = new_corrections(
            store,
            match,
            match.journal,
            tuple(fresh.values()),
            who=who,
            note=note,
            results=store.run(match.match_id).results if runs else {},
            ids=tuple(fresh),
        )
        made = {each.id: each for each in corrections}
        if not corrections or append(store, match.journal, corrections) is not None:
            return [made.get(name) or said[name] for name in given]


def next_id(journal: Journal, name: str) -> str:
    """Return the id, numbered if corrections with it were withdrawn."""
    given, number = name, 1
    while name in journal.corrections and name not in journal.standing:
        number += 1
        name = f"{given}.{number}"
    return name


def _require_unchanged(folder: MatchFolder, standing: Sequence[Correction], edit: Edit) -> None:
    """Refuse an edit whose `was` differs from the current value; name the author of the change."""
    if not isinstance(edit, MovedPoint | RedrawnMarking) or current_value(folder, edit) == edit.was:
        return
    place = (edit.camera, edit.frame, edit.marking)
    last = [
        each
        for each in standing
        if isinstance(each.edit, MovedPoint | RedrawnMarking)
        and (each.edit.camera, each.edit.frame, each.edit.marking) == place
    ][-1:]
    now = current_value(folder, edit)
    found = f"{now or 'not there'}" + "".join(f", by {each.who}" for each in last)
    error = StaleEditError(
        f"{edit.marking} in {edit.camera}",
        expected=f"{edit.was or 'not there'}, as it was when this was begun",
        found=found,
        todo="Reload the page, and repeat the correction if it is still needed.",
    )
    error.difference = {
        "camera": edit.camera,
        "frame": edit.frame,
        "marking": edit.marking,
        "was": edit.was,
        "now": now,
        "who": last[0].who if last else None,
    }
    raise error
