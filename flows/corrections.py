"""Corrections of a match: taken in, taken back, and laid over what its folder holds."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

from data_contracts.match import Registration
from data_contracts.review import Correction, Edit, Withdrawal
from flows.stage import Match
from worldpose.errors import InputError
from worldpose.ingest import MatchFolder
from worldpose.review import (
    Journal,
    read_journal,
    replay_corrections,
    standing_corrections,
    with_was,
)
from worldpose.store import Store


def corrected_match(store: Store, folder: MatchFolder, registration: Registration) -> Match:
    """The match as people have corrected it; no file of its folder changes."""
    journal = read_journal(store, registration.spec.match_id)
    replay = replay_corrections(folder, standing_corrections(journal.records))
    return Match(replay.folder, registration, journal, replay.applied, replay.stale)


def new_corrections(
    match: Match,
    journal: Journal,
    edits: Sequence[Edit],
    *,
    who: str,
    note: str,
    results: Mapping[str, str],
) -> list[Correction]:
    """Edits as corrections to be said, each based on those before it.

    Args:
        match: as it was opened; its folder has the corrections that were standing then.
        journal: as it is now.
        edits: in the order they are to be applied.
        who: the person.
        note: in the person's words.
        results: `stage/unit` to key of what the person looked at.

    Raises:
        InputError: an edit that does not apply, because of what it names or of what somebody else
            did in between; nothing is kept of any.
    """
    standing = standing_corrections(journal.records)
    if standing != standing_corrections(match.journal.records):
        raise InputError(
            f"corrections of {match.match_id}",
            expected="those that were there when this was begun",
            found="others, made in between",
            todo="Look at them with `worldpose review show`, and correct again.",
        )
    folder, said = match.folder, []
    for number, edit in enumerate(edits):
        correction = Correction(
            id=f"{edit.kind}.{uuid.uuid4().hex[:12]}",
            match_id=match.match_id,
            edit=with_was(folder, edit),
            who=who,
            made_at=datetime.now(UTC),
            based_on=_looked_at(edit, results),
            note=note or None,
        )
        replay = replay_corrections(folder, [correction])
        if replay.stale or replay.folder == folder:
            raise InputError(
                f"edit {number + 1} of {len(edits)}, {edit.kind}",
                expected="one that applies",
                found=replay.stale[0][1] if replay.stale else "one that changes nothing",
                todo="Correct it; none of these edits was taken in.",
            )
        folder = replay.folder
        said.append(correction)
    return said


def withdrawal(journal: Journal, correction: str, *, who: str, why: str) -> Withdrawal:
    """A correction taken back, to be said.

    Raises:
        InputError: no such correction stands.
    """
    standing = [each.id for each in standing_corrections(journal.records)]
    if correction not in standing:
        raise InputError(
            f"correction {correction}",
            expected=f"one of {', '.join(standing) or '(none)'}",
            found="no such correction",
            todo="List them with `worldpose review show MATCH`.",
        )
    return Withdrawal(
        match_id=journal.match_id,
        correction=correction,
        who=who,
        why=why,
        withdrawn_at=datetime.now(UTC),
    )


def _looked_at(edit: Edit, results: Mapping[str, str]) -> dict[str, str]:
    """The results that an edit is about."""
    unit = getattr(edit, "camera", None) or getattr(edit, "clip", None)
    return {name: key for name, key in results.items() if name.partition("/")[2] == unit}
