"""State of a served project: arrivals in the inbox and addresses of its services."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from data_contracts.records import CONTRACT_VERSION, Amount, Count, ProcessId, Record

ArrivalState = Literal["arriving", "incomplete", "refused", "taken"]
"""arriving: changed recently; incomplete: something is missing; refused: invalid as a match; taken:
a registered match."""

Priority = Literal["urgent", "normal", "background"]
"""Order in which matches run."""


class Arrival(Record):
    """One entry of the inbox."""

    contract: Literal[1] = CONTRACT_VERSION
    name: str
    """Path below the inbox; characters that are not plain ASCII are escaped."""
    state: ArrivalState
    reason: str = ""
    """Reason of the state."""
    priority: Priority = "normal"
    fingerprint: str = ""
    """Digest of the names, sizes and times of all its files at the last scan."""
    unchanged_since: Amount = 0.0
    """Time of the first scan with these files, on the machine's monotonic clock [s]."""
    is_begun: bool = False
    """Whether registration has begun and not ended; written before the first of its files is read.
    """
    deaths: Count = 0
    """How often the registering process died with these files."""
    match_id: str | None = None
    """Id of the registered match."""
    flow_run: str | None = None
    """Prefect's id of its run."""
    changed_at: datetime
    """Time of the last change of state."""


class Service(Record):
    """One process of a served project."""

    pid: ProcessId
    address: str | None = None
    """Address of its server; None if it serves nothing."""


class Serving(Record):
    """serve.json: the processes that `worldpose serve` has started, without secrets."""

    contract: Literal[1] = CONTRACT_VERSION
    project: str
    """Folder or URL of the store."""
    inbox: str
    """The watched folder."""
    name: str
    """Name of the deployments and pools at the Prefect server."""
    prefect: str
    """Address of Prefect's API."""
    owns_prefect: bool
    """Whether the Prefect server ends with `worldpose serve`."""
    services: dict[str, Service]
    """Name to process."""
    started_at: datetime
