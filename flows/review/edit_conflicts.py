"""Edits that conflict with newer edits, and results that edits made stale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from pydantic import JsonValue

from data_contracts.records import Record
from data_contracts.run import RunRecord
from worldpose.errors import InputError
from worldpose.store.recipes import recipe_key
from worldpose.store.store import Store

if TYPE_CHECKING:
    import xarray as xr

E = TypeVar("E", bound=Record)
MOST_REPLAYED: Final = 50
"""Most corrections of a camera or clip that are replayed to tell of them: a page waits for it."""


class StaleEditError(InputError):
    """The edited value changed after the reviewer looked at it."""

    difference: Mapping[str, Any] = {}

    @classmethod
    def of_edit(
        cls, where: str, subject: str, place: str, objection: str, **difference: object
    ) -> StaleEditError:
        """Return the error of an edit that does not fit what a page showed."""
        error = cls(
            where,
            expected=f"a correction that fits the current {subject}",
            found=objection,
            todo=f"Load the {place} again and repeat the correction if it is still needed.",
        )
        error.difference = {**difference, "now": objection}
        return error


class EditedMeanwhileError(InputError):
    """The match changed since the previous iteration was computed."""


def edits_since(
    said: Sequence[E], taken_in: Sequence[JsonValue], place: str, match_id: str
) -> Sequence[E]:
    """Return those of the edits in force, `said`, that a result has not `taken_in` yet.

    InputError if it contains one that was withdrawn since: the state without that is unknown.
    """
    first, later = said[: len(taken_in)], said[len(taken_in) :]
    if [edit.model_dump(mode="json") for edit in first] != list(taken_in):
        raise InputError(
            f"{match_id}, {place}",
            expected="a result without the corrections that were withdrawn since",
            found="one that contains them",
            todo=f"Run the match first: worldpose run {match_id}.",
        )
    return later


class StoredResult(NamedTuple):
    """A result of a run, without corrections if that version is stored.

    `plain` is the key of the result without corrections, `edits` are those that it contains, as its
    recipe lists them.
    """

    result: xr.Dataset
    plain: str
    edits: list[JsonValue]


def open_stored(
    store: Store, run: RunRecord, name: str, source: str, said: Sequence[Record] = ()
) -> StoredResult:
    """Open a run's result by `stage/unit`; `source` names its recipe's corrections.

    If these are the first of `said`, the result itself is opened, with its corrections.
    """
    stage, _, unit = name.partition("/")
    match_id, key = run.match_id, run.results[name]
    recipe = store.manifest(match_id, stage, unit, key).recipe
    sources = dict(recipe.sources)
    taken_in = sources.pop(source, None) or []
    assert isinstance(taken_in, list)
    plain = recipe_key(recipe.model_copy(update={"sources": sources}))
    is_own = taken_in == [edit.model_dump(mode="json") for edit in said[: len(taken_in)]]
    if not (said and is_own) and store.has(match_id, stage, unit, plain):
        key, taken_in = plain, []
    return StoredResult(store.open_result(match_id, stage, unit, key), plain, taken_in)


def require_results(found: Sequence[str], place: str, subject: str, match_id: str) -> None:
    """Raise InputError if the latest run has no results of a subject."""
    if not found:
        raise InputError(
            f"{match_id}, {place}",
            expected=f"{subject} in the latest run",
            found="none",
            todo=f"Run the match first: worldpose run {match_id}.",
        )
