"""State of a served project: arrivals in the inbox and addresses of its services."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import JsonValue

from data_contracts.records import CONTRACT_VERSION, Amount, Count, Name, ProcessId, Record, Share

ArrivalState = Literal["arriving", "incomplete", "refused", "taken"]
"""arriving: changed recently; incomplete: something is missing; refused: invalid as a match; taken:
a registered match."""

Priority = Literal["urgent", "normal", "background"]
"""Order in which matches run."""

QueueState = Literal["asked", "begun", "waiting", "killed", "complete", "failed", "cancelled"]
"""asked: due; begun: its process computes; waiting: for review; killed: it restarts; the others are
ends."""


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


class QueuedRun(Record):
    """One state of a run that a served project queued; the state with the highest number holds."""

    contract: Literal[1] = CONTRACT_VERSION
    id: Name
    number: Count = 1
    """Number of this state, from 1."""
    flow: str
    """Name of its deployment's flow."""
    name: str
    """Name that pages and Prefect show."""
    match_id: str = ""
    """Empty for a run without a match."""
    parameters: dict[str, JsonValue] = {}
    """Parameters of this run, without those of its deployment."""
    priority: Priority | None = None
    """None: that of its deployment."""
    key: str = ""
    """A second request with the same key is the same run; empty: none is."""
    state: QueueState = "asked"
    message: str = ""
    """Reason of the state."""
    stalled: str = ""
    """Why an earlier process of the run was ended: what it did when progress stopped."""
    flow_run: str
    """Prefect's id of it."""
    kills: Count = 0
    """How often its process was killed, or its machines were lost."""
    service_deaths: Count = 0
    """How often its process ended with the whole service."""
    host: str = ""
    """Machine of its process."""
    pid: ProcessId | None = None
    worker_pid: ProcessId | None = None
    """Process that started it."""
    asked_at: datetime
    changed_at: datetime


class Heartbeat(Record):
    """Progress of a run that is being computed; its process writes it, and replaces it."""

    contract: Literal[1] = CONTRACT_VERSION
    number: Count
    """It grows while the run makes progress."""
    share: Share
    """Computed share of the run [0..1]."""
    doing: str
    """Stage with the units left, and the expected time left."""
    at: datetime
