"""Current identities of a clip: the tracker's output with all corrections since."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import JsonValue

from data_contracts.review import Edit
from flows.review.edit_conflicts import StaleEditError, edits_since
from flows.stage import Match
from worldpose.errors import InputError
from worldpose.review.identities import (
    IDENTITY_EDITS,
    Identities,
    IdentityReplay,
    find_objection,
    replay_identities,
    stored_identities,
)
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store


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
    found, taken_in = _open_tracker_output(store, match, clip)
    later = edits_since(said, taken_in, f"clip {clip}", match.match_id)
    return replay_identities(found, later)


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
            error = StaleEditError(
                f"clip {edit.clip}, {edit.kind}",
                expected="a correction that fits the current identities",
                found=objection,
                todo="Load the clip again and repeat the correction if it is still needed.",
            )
            error.difference = {"clip": edit.clip, "kind": edit.kind, "now": objection}
            raise error
        found[edit.clip] = replay_identities(found[edit.clip], [edit]).identities


def _open_tracker_output(
    store: Store, match: Match, clip: str
) -> tuple[Identities, list[JsonValue]]:
    """Return the tracker's output of the latest run, and the corrections that it contains."""
    runs = store.runs(match.match_id)
    key = store.run(match.match_id).results.get(f"tracking/{clip}") if runs else None
    if key is None:
        raise InputError(
            f"{match.match_id}, clip {clip}",
            expected="tracks in the latest run",
            found="none",
            todo=f"Run the match first: worldpose run {match.match_id}.",
        )
    match_id, stage = match.match_id, "tracking"
    recipe = store.manifest(match_id, stage, clip, key).recipe
    sources = dict(recipe.sources)
    taken_in = sources.pop("identities", None) or []
    assert isinstance(taken_in, list)
    plain = recipe_key(recipe.model_copy(update={"sources": sources}))
    if taken_in and not store.has(match_id, stage, clip, plain):
        return stored_identities(store.open_result(match_id, stage, clip, key)), taken_in
    return stored_identities(store.open_result(match_id, stage, clip, plain)), []
