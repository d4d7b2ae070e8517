"""Current identities of a clip: the tracker's output with all corrections since."""

from __future__ import annotations

from collections.abc import Sequence

from data_contracts.review import Edit, NamedTrack
from flows.review.edit_conflicts import (
    StaleEditError,
    edits_since,
    open_stored,
    require_results,
)
from flows.stage import Match
from worldpose.review.identities import (
    IDENTITY_EDITS,
    TRACK_EDITS,
    Identities,
    IdentityReplay,
    find_objection,
    replay_identities,
    stored_identities,
)
from worldpose.review.journal import read_journal
from worldpose.store.store import Run, Store


def identities_now(store: Store, match: Match, clip: str) -> IdentityReplay:
    """Return the tracks of a clip with all corrections, including those no run contains yet.

    Raises:
        InputError: the latest run has no tracks of this clip, or only with a correction that was
            withdrawn since.
    """
    said = [
        correction.edit
        for correction in match.corrections
        if isinstance(correction.edit, IDENTITY_EDITS) and correction.edit.clip == clip
    ]
    name, match_id = f"tracking/{clip}", match.match_id
    results = store.run(match_id).results if store.runs(match_id) else {}
    require_results([name] if name in results else [], f"clip {clip}", "tracks", match_id)
    stored = open_stored(store, store.run(match_id), name, "identities")
    moved = [edit for edit in said if isinstance(edit, TRACK_EDITS)]
    later = edits_since(moved, stored.edits, f"clip {clip}", match_id)
    edits = [edit for edit in said if isinstance(edit, NamedTrack) or edit in later]
    return replay_identities(stored_identities(stored.result), edits)


def names_of(run: Run, clip: str) -> dict[int, str]:
    """Return the newest names of a run's people by id.

    A name belongs to no result: the journal's names are replayed over the tracks of the run, in
    order with the merges and splits that these contain.
    """
    match_id, unit = run.record.match_id, f"tracking/{clip}"
    journal = read_journal(run.store, match_id)
    said = [
        (each.id, each.edit)
        for each in journal.corrections.values()
        if isinstance(each.edit, IDENTITY_EDITS) and each.edit.clip == clip
    ]
    named = {n for n, edit in said if isinstance(edit, NamedTrack) and n in journal.standing}
    if unit not in run or not named:
        return {}
    stored = open_stored(run.store, run.record, unit, "identities")
    moves = run.manifest(unit).recipe.sources.get("identities") or []
    assert isinstance(moves, list)
    contained = moves if not stored.edits else []
    edits = [edit for n, edit in said if n in named or edit.model_dump(mode="json") in contained]
    tracks = stored_identities(stored.result, with_joints=False)
    return replay_identities(tracks, edits).identities.names


def require_fitting(store: Store, match: Match, edits: Sequence[Edit]) -> None:
    """Refuse identity corrections that do not fit the current tracks.

    Raises:
        StaleEditError: another person changed the identities, or the edit never fitted.
    """
    found: dict[str, Identities] = {}
    for edit in edits:
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
        found[edit.clip] = replay_identities(found[edit.clip], [edit]).identities
