"""The error of an edit that somebody else was quicker than."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import JsonValue

from worldpose.errors import InputError


class StaleEditError(InputError):
    """Somebody changed what an edit changes, after the person who edits looked at it.

    Attributes:
        difference: what it was to the editor, what it is now, and who made it that.
    """

    difference: Mapping[str, JsonValue] = {}
