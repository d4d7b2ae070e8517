"""A run that has a name and is kept."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from data_contracts.records import CONTRACT_VERSION, Name, Record


class Pin(Record):
    """pins/<match>/<name>.json: a run that is kept under a name and never collected."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    name: Name
    """Name of the run; neither a number nor `latest`."""
    run_id: Name
    """Its number."""
    who: str
    """Name of the person who pinned it."""
    why: str
    """Reason in the person's words; may be empty."""
    pinned_at: datetime
