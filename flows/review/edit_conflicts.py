"""Edits that conflict with newer edits, and results that edits made stale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import JsonValue

from data_contracts.records import Record
from worldpose.errors import InputError

E = TypeVar("E", bound=Record)


class StaleEditError(InputError):
    """The edited value changed after the reviewer looked at it.

    Attributes:
        difference: value that the editor saw, current value, and who changed it.
    """

    difference: Mapping[str, Any] = {}


class EditedMeanwhileError(InputError):
    """The match changed since the previous iteration was computed."""


def edits_since(
    said: Sequence[E], taken_in: Sequence[JsonValue], place: str, match_id: str
) -> Sequence[E]:
    """Return the edits in force that a result does not contain yet.

    Args:
        said: all edits in force, in order.
        taken_in: edits that the result contains, as its recipe lists them.
        place: name of the result, for messages.
        match_id: the match.

    Raises:
        InputError: the result contains an edit that was withdrawn since, so that the state without
            it is unknown.
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
