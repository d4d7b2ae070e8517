"""A run that has a name and is kept."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from data_contracts.records import CONTRACT_VERSION, Name, Record


class Pin(Record):
    """pins/<match>/<name>.json: a run is kept under a name, whatever else is forgotten."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    name: Name
    """What people call the run; no number, and not `latest`."""
    run_id: Name
    """Its number."""
    who: str
    """Name of the person who pinned it."""
    why: str
    """In the person's words; may be empty."""
    pinned_at: datetime
