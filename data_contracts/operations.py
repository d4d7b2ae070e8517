"""What a served project keeps beside its results: arrivals and where its services are."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from data_contracts.records import CONTRACT_VERSION, Amount, Count, ProcessId, Record

ArrivalState = Literal["arriving", "incomplete", "refused", "taken"]
"""arriving: it changed a moment ago; incomplete: something is missing; refused: it can never be a
match as it is; taken: it is a registered match."""

Priority = Literal["urgent", "normal", "background"]
"""Which matches run first."""


class Arrival(Record):
    """One entry of the inbox."""

    contract: Literal[1] = CONTRACT_VERSION
    name: str
    """Path below the inbox; characters that are not plain ASCII are escaped."""
    state: ArrivalState
    reason: str = ""
    """Why it is where it is, for people."""
    priority: Priority = "normal"
    fingerprint: str = ""
    """Digest of the names, sizes and times of all its files as they were last seen."""
    unchanged_since: Amount = 0.0
    """When it was first seen like this, on this machine's clock that only goes forward [s]."""
    is_begun: bool = False
    """Whether taking it in has begun and not ended; written before the first of its files is read.
    """
    deaths: Count = 0
    """How often the process that took it in, as it is now, ended in the middle of that."""
    match_id: str | None = None
    """The match that it became."""
    flow_run: str | None = None
    """Prefect's id of the run that it was given."""
    changed_at: datetime
    """When its state last changed."""


class Service(Record):
    """One process of a served project."""

    pid: ProcessId
    address: str | None = None
    """Where it answers; None for one that only works."""


class Serving(Record):
    """serve.json: what `worldpose serve` has started, without any secret."""

    contract: Literal[1] = CONTRACT_VERSION
    project: str
    """Folder or URL of the store."""
    inbox: str
    """The folder that is watched."""
    name: str
    """Of the deployments and pools at the Prefect server."""
    prefect: str
    """Address of Prefect's API."""
    owns_prefect: bool
    """Whether the Prefect server ends with it."""
    services: dict[str, Service]
    """Name to process."""
    started_at: datetime
