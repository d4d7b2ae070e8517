"""The errors of an edit that somebody else was quicker than, and of work that an edit overtook."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from worldpose.errors import InputError


class StaleEditError(InputError):
    """Somebody changed what an edit changes, after the person who edits looked at it.

    Attributes:
        difference: what it was to the editor, what it is now, and who made it that.
    """

    difference: Mapping[str, Any] = {}


class EditedMeanwhileError(InputError):
    """The match is no longer as it was when the iteration before was computed."""
