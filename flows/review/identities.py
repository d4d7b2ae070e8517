"""Current identities of a clip: the tracker's output with all corrections since."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from pydantic import JsonValue

from data_contracts.review import Edit, MergedTracks, NamedTrack, SplitTrack
from flows.review.edit_conflicts import (
    MOST_REPLAYED,
    StaleEditError,
    StoredResult,
    edits_since,
    open_stored,
    require_results,
)
from flows.stage import Match
from worldpose.review.identities import (
    IDENTITY_EDITS,
    TRACK_EDITS,
    Identities,
    IdentityEdit,
    IdentityReplay,
    find_objection,
    find_sighting,
    replay_identities,
    stored_identities,
)
from worldpose.review.journal import MOST_KEPT, Journal, read_journal
from worldpose.store.store import Run, Store

T = TypeVar("T")


def said_of(match: Match, clip: str) -> list[IdentityEdit]:
    """Return a clip's identity corrections that apply to the match folder, in order."""
    edits = (correction.edit for correction in match.corrections)
    return [edit for edit in edits if isinstance(edit, IDENTITY_EDITS) and edit.clip == clip]


def identities_now(
    store: Store, match: Match, clip: str, *, with_joints: bool = True
) -> IdentityReplay:
    """Return the tracks of a clip with all corrections, including those no run contains yet.

    InputError if the latest run has no tracks of this clip, or only with a correction that was
    withdrawn since.
    """
    said = said_of(match, clip)
    name, match_id = f"tracking/{clip}", match.match_id
    results = store.run(match_id).results if store.runs(match_id) else {}
    require_results([name] if name in results else [], f"clip {clip}", "tracks", match_id)
    stored = open_stored(store, store.run(match_id), name, "identities")
    moves = [edit for edit in said if isinstance(edit, TRACK_EDITS)]
    edits_since(moves, stored.edits, f"clip {clip}", match_id)
    stated = _stated_names(store, match_id, clip)
    made = store.manifest(match_id, "tracking", clip, results[name]).recipe.sources
    taken = made.get("identities") or []
    assert isinstance(taken, list)  # corrections as JSON
    as_json = [edit.model_dump(mode="json") for edit in moves[: len(taken)]]
    in_run = len(taken) if as_json == taken else 0  # some can be withdrawn
    return once(
        (store, f"{match_id}/{clip} {with_joints}", 2),
        (results[name], stored.edits, said, stated),
        lambda: _replay(stored, said, stated, in_run, with_joints=with_joints),
    )


def once(kept_as: tuple[Store, str, int], state: object, make: Callable[[], T]) -> T:
    """Return what is made of a state, or was made of it before.

    `kept_as` has the store, the place, and how many places with this number are kept.
    """
    store, place, most = kept_as
    kept = _MADE.setdefault(store, {}).setdefault(most, {})
    before, made = kept.pop(place, (None, None))
    made = made if made is not None and before == state else make()
    kept[place] = state, made
    while len(kept) > most:
        kept.pop(next(iter(kept)), None)
    return made


_MADE: WeakKeyDictionary[Store, dict[int, dict[str, tuple[object, Any]]]] = WeakKeyDictionary()


def identity_objections(store: Store, match: Match, clip: str) -> dict[int, str | None]:
    """Return why a clip's corrections that its latest tracks lack do not apply, by their index.

    Those of them that apply have None. Objections to all others are in the tracks. After more than
    `MOST_REPLAYED` merges and splits, or before any tracks, there are none. InputError as
    `identities_now`.
    """
    said = said_of(match, clip)
    moves = [edit for edit in said if isinstance(edit, TRACK_EDITS)]
    run, name = store.run(match.match_id), f"tracking/{clip}"
    require_results([name] if name in run.results else [], f"clip {clip}", "tracks", run.match_id)
    stored = open_stored(store, run, name, "identities", moves)
    later = edits_since(moves, stored.edits, f"clip {clip}", run.match_id)
    is_own = bool(stored.edits) or run.results[name] == stored.plain
    if len(later) > MOST_REPLAYED or (is_own and not later):
        return {}
    replay = _replay(stored, said, {}, len(stored.edits), with_joints=False)
    contained = (n for n, edit in enumerate(said) if isinstance(edit, TRACK_EDITS))
    first = [*contained][len(stored.edits)] if stored.edits else 0
    return dict([*enumerate(replay.objections)][first:])


def names_said(match: Match) -> str:
    """Return a text that changes with the names of people, and with no other correction."""
    standing = match.journal.standing.items()
    named = (name for name, each in standing if isinstance(each.edit, NamedTrack))
    return f"{' '.join(sorted(named))} {[each.people for each in match.folder.spec.clips]}"


def names_of(run: Run, clip: str) -> dict[int, str]:
    """Return the newest names of a run's people by id.

    A name belongs to no result: the journal's names are replayed in order with the merges and
    splits that the tracks of the run contain. Whom they do not decide has the name that match.yaml
    states now, by id: only if these are the tracks of the latest run.
    """
    return _replay_names(run, clip)[1]


def lost_names(run: Run) -> dict[str, str]:
    """Return why names fit no person of a run any more, by the ids of their corrections.

    Names of match.yaml have clip and person for an id, those for the tracks of a later run the
    clip. A name that another person got is not lost.
    """
    lost: dict[str, str] = {}
    for unit, key in run.record.results.items():
        stage, _, clip = unit.partition("/")
        if stage in ("tracking", "broadcast_tracking") and run.store.has(
            run.record.match_id, stage, clip, key
        ):
            lost |= _replay_names(run, clip)[0]
    return lost


def _replay_names(run: Run, clip: str) -> tuple[dict[str, str], dict[int, str]]:
    """Return lost names with the reasons, by correction, and all others by person."""
    match_id, unit = run.record.match_id, f"tracking/{clip}"
    journal, stated = read_journal(run.store, match_id), _stated_names(run.store, match_id, clip)
    plane, lost = f"broadcast_tracking/{clip}", dict[str, str]()
    latest = run.store.run(match_id).results if stated else {}
    if stated and any(latest.get(n) != run.record.results.get(n) for n in (unit, plane)):
        stated = {}
        lost[clip] = (
            f"the names of clip {clip} in match.yaml belong to the people of the latest run, and "
            "this run has other tracks: they are left out. Open the latest run"
        )
    if unit not in run:
        ids = run[plane]["person"].values.tolist() if plane in run else [*stated]
        names = {person: name for person, name in stated.items() if person in ids}
        return lost | _lost_stated(clip, stated, ids, names), names
    if not stated and not any(
        isinstance(each.edit, NamedTrack) and each.edit.clip == clip
        for each in journal.standing.values()
    ):
        return lost, {}
    moves = run.manifest(unit).recipe.sources.get("identities") or []
    assert isinstance(moves, list)
    said = _said_in(journal, clip, moves)
    stored = open_stored(run.store, run.record, unit, "identities")
    replay = once(
        (run.store, f"{match_id}/{run.record.run_id}/{clip}", MOST_KEPT),
        (run.record.results[unit], stored.edits, said, stated),
        lambda: _replay(stored, [*said.values()], stated, len(moves), with_joints=False),
    )
    ids, names = replay.identities.person.tolist(), replay.identities.names
    lost |= {
        name: f"{edit.name!r} names no person: {why}. Name the person again, or withdraw the name"
        for (name, edit), why in zip(said.items(), replay.objections, strict=True)
        if isinstance(edit, NamedTrack) and edit.name and why and edit.name not in names.values()
    }
    return lost | _lost_stated(clip, stated, ids, names), names


def _said_in(journal: Journal, clip: str, moves: Sequence[JsonValue]) -> dict[str, IdentityEdit]:
    """Return the names in force and the merges and splits of a result, in order, by correction.

    Corrections can be equal: those of a result are the first in force, or the newest that fit if
    some were withdrawn since.
    """
    own: dict[str, IdentityEdit] = {}
    for name, each in journal.corrections.items():
        if isinstance(each.edit, IDENTITY_EDITS) and each.edit.clip == clip:
            own[name] = each.edit
    as_json = {name: edit.model_dump(mode="json") for name, edit in own.items()}
    names = {name for name, edit in own.items() if isinstance(edit, NamedTrack)}
    taken = [name for name in journal.standing if name in own.keys() - names][: len(moves)]
    if [as_json[name] for name in taken] != moves:
        taken, left = [], [*moves]
        for name in reversed(own):
            if left and as_json[name] == left[-1]:
                taken.append(name)
                left.pop()
    kept = {*taken, *(names & journal.standing.keys())}
    return {name: edit for name, edit in own.items() if name in kept}


def _stated_names(store: Store, match_id: str, clip: str) -> dict[int, str]:
    """Return the names of a clip's people in match.yaml, by person."""
    registration = store.registration(match_id)
    clips = () if registration is None else registration.spec.clips
    return next((dict(each.people) for each in clips if each.id == clip), {})


def _lost_stated(
    clip: str, stated: Mapping[int, str], ids: Collection[int], names: Mapping[int, str]
) -> dict[str, str]:
    """Return why names of match.yaml fit no person, by clip and person."""
    return {
        f"{clip}/{person}": f"{name!r} in match.yaml names no person: clip {clip} has no person "
        f"{person}. Correct the clip's `people`"
        for person, name in stated.items()
        if person not in ids and name not in names.values()
    }


def _replay(
    stored: StoredResult,
    said: Sequence[IdentityEdit],
    stated: Mapping[int, str],
    in_run: int,
    *,
    with_joints: bool = True,
) -> IdentityReplay:
    """Replay corrections over a result, which can contain the first merges and splits already.

    People without a name by a correction have the names `stated`, unless a merge removed their id
    and the run, which contains the first `in_run` merges and splits, has no person with it. The
    objections are in the order of `said`.
    """
    merged, others = dict[int, IdentityEdit](), dict[int, IdentityEdit]()
    moves = (number for number, edit in enumerate(said) if isinstance(edit, TRACK_EDITS))
    taken = dict(zip(moves, stored.result.attrs["objections"], strict=False))
    for number, edit in enumerate(said):
        if isinstance(edit, NamedTrack):
            person, seen = edit.person, edit.seen
            for move in (said[n] for n, why in taken.items() if n > number and why is None):
                if isinstance(move, MergedTracks) and move.merged == person:
                    person = move.kept
                elif isinstance(move, SplitTrack) and move.person == person:
                    seen = None  # it can belong to the new person, and the name does not
            after = edit.model_copy(update={"person": person, "seen": seen})
            (others if person == edit.person else merged)[number] = after
        elif number not in taken:
            others[number] = edit
    tracks = stored_identities(stored.result, with_joints=with_joints)
    order = merged | others  # a person's own name counts more
    replay = replay_identities(tracks, order.values())
    found = taken | dict(zip(order, replay.objections, strict=True))
    objections = tuple(found.get(number) for number in range(len(said)))
    nameless = _merged_away(tracks.person.tolist(), said, objections, len(taken), in_run) | {
        edit.person
        for number, edit in others.items()
        if isinstance(edit, NamedTrack) and edit.name is None and found[number] is None
    }
    now = replay.identities
    left = {who: name for who, name in stated.items() if who in now.person and who not in nameless}
    return IdentityReplay(replace(now, names=left | now.names), objections)


def _merged_away(
    ids: Sequence[int],
    said: Sequence[IdentityEdit],
    objections: Sequence[str | None],
    taken: int,
    in_run: int,
) -> set[int]:
    """Return ids that merges removed and the run lacks; a later split can give them to others.

    The ids are those after the first merges and splits that were `taken`.
    """
    now, gone = {*ids}, set[int]()
    moves = [
        (edit, why)
        for edit, why in zip(said, objections, strict=True)
        if isinstance(edit, TRACK_EDITS)
    ]
    for number, (edit, why) in enumerate([*moves, (None, None)]):
        if number == in_run:
            gone -= now
        if why is None and isinstance(edit, MergedTracks):
            gone.add(edit.merged)
            now -= {edit.merged} if number >= taken else set()
        elif why is None and isinstance(edit, SplitTrack) and number >= taken:
            now.add(max(now) + 1)  # as the replay numbers the new person
    return gone


def require_fitting(store: Store, match: Match, edits: Sequence[Edit]) -> list[Edit]:
    """Return edits, those of identities with sightings of their people in the current tracks.

    Without sightings, an edit would apply to another person whom later tracks give the id.
    StaleEditError if another person changed the identities, or the edit never fitted.
    """
    found: dict[str, Identities] = {}
    seen = list(edits)
    for number, edit in enumerate(edits):
        if not isinstance(edit, IDENTITY_EDITS):
            continue
        if edit.clip not in found:
            found[edit.clip] = identities_now(store, match, edit.clip).identities
        objection = find_objection(found[edit.clip], edit)
        if objection is not None:
            raise StaleEditError.of_edit(
                f"clip {edit.clip}, {edit.kind}",
                *("identities", "clip", objection),
                clip=edit.clip,
                kind=edit.kind,
            )
        seen[number] = _add_sightings(found[edit.clip], edit)
        found[edit.clip] = replay_identities(found[edit.clip], [edit]).identities
    return seen


def _add_sightings(found: Identities, edit: IdentityEdit) -> IdentityEdit:
    """Return an edit that applies to `found`, with sightings of its people where it has none."""
    people = {"seen": "person", "kept_seen": "kept", "merged_seen": "merged"}
    update = {
        seen: find_sighting(found, getattr(edit, person))
        for seen, person in people.items()
        if hasattr(edit, person) and getattr(edit, seen) is None
    }
    return edit.model_copy(update=update)
