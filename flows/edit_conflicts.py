"""Edits that somebody else was quicker than, and results and work that edits overtook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import JsonValue

from data_contracts.records import Record
from worldpose.errors import InputError

E = TypeVar("E", bound=Record)


class StaleEditError(InputError):
    """Somebody changed what an edit changes, after the person who edits looked at it.

    Attributes:
        difference: what it was to the editor, what it is now, and who made it that.
    """

    difference: Mapping[str, Any] = {}


class EditedMeanwhileError(InputError):
    """The match is no longer as it was when the iteration before was computed."""


def edits_since(
    said: Sequence[E], taken_in: Sequence[JsonValue], place: str, match_id: str
) -> Sequence[E]:
    """The edits that stand and that a result does not hold yet.

    Args:
        said: all that stand, in order.
        taken_in: those that the result holds, as its recipe names them.
        place: what it is the result of, for people.
        match_id: the match.

    Raises:
        InputError: the result holds one that was withdrawn since, so that it does not tell how
            things are without.
    """
    first, later = said[: len(taken_in)], said[len(taken_in) :]
    if [edit.model_dump(mode="json") for edit in first] != list(taken_in):
        raise InputError(
            f"{match_id}, {place}",
            expected="a result without the corrections that were withdrawn since",
            found="one that holds them",
            todo=f"Run it first: worldpose run {match_id}.",
        )
    return later
