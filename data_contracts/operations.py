"""State of a served project: arrivals in the inbox and addresses of its services."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import JsonValue

from data_contracts.records import (
    CONTRACT_VERSION,
    Amount,
    Count,
    Name,
    Number,
    ProcessId,
    Record,
    Share,
)
from data_contracts.run import RunRecord

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
    """Path below the inbox; characters that cannot be printed are escaped."""
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
    replaces: str | None = None
    """Folder of the registered match whose next version it is; None of any other match."""
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
    certificate: str | None = None
    """PEM file of the certificate of the pages."""
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


UnitProgress = Literal["done", "waiting", "failed", "blocked"]
"""waiting: for review; blocked: by a unit that is not done."""


class UnitSummary(Record):
    """One unit of a match's latest run."""

    unit: str
    """Name within its stage, often the id of a camera or clip."""
    state: UnitProgress
    seconds: Amount | None = None
    """Computation time [s]; None if there is no result."""
    figures: dict[str, float] = {}
    """Its quality metrics."""
    objections: tuple[str, ...] = ()
    """Metrics beyond the gate's limits without an approval."""
    waiting_since: datetime | None = None
    """Time of the review request; None if there is none."""
    why: str = ""
    """Reason for the failure or the review."""
    bytes: Count = 0
    """Size of the files of its result [byte]."""


class Question(Record):
    """A result that waits for review."""

    id: str
    """Id of the review request."""
    unit: str
    """Unit as `stage/unit`."""
    reasons: tuple[str, ...] = ()
    rejected: bool = False
    since: datetime | None = None
    """Time of the request."""
    excess: Number = 0.0
    """Relative excess of the worst metric over its limit [1]."""


class MatchSummary(Record):
    """summaries/<match>.json: what lists of matches show of one; derived from all else."""

    contract: Literal[1] = CONTRACT_VERSION
    match_id: Name
    made_from: str = ""
    """Digest of what it was made from; empty if that changed meanwhile: it is made again."""
    watched: tuple[str, ...] = ()
    """Files and folders that it was made from: of the project, or absolute."""
    is_unseen: bool = False
    """Whether it was not made or verified yet; never stored."""
    is_silent: bool = False
    """Whether a disk did not answer in time; never stored."""
    problem: str = ""
    """Why the match cannot be opened."""
    kind: str = ""
    """Kind of its state (`flows.match_state.StateName`)."""
    words: str = ""
    """The state in a few words, such as `2 questions`."""
    why: str = ""
    """Reason of the state, in sentences."""
    todo: str = ""
    """Remedy, in sentences."""
    seconds: Amount | None = None
    """Expected time of the next run [s]; None if it computes nothing or is unknown."""
    units: dict[str, tuple[str, ...]] = {}
    """State of units relative to the latest run to their names, as `stage/unit`."""
    latest: RunRecord | None = None
    """Latest finished run, without its results, settings, figures and versions."""
    stages: dict[str, tuple[UnitSummary, ...]] = {}
    """Stage to the units of the latest run, in the order of the method."""
    progress: dict[str, dict[UnitProgress, Count]] = {}
    """Stage to the number of its units by state."""
    open_run: str = ""
    """Last run that has not ended, in words; empty without one."""
    running_since: datetime | None = None
    """Start of a run later than the latest finished one."""
    waiting: tuple[Question, ...] = ()
    to_click: tuple[str, ...] = ()
    """Cameras that need clicks."""
    has_image: bool = False
    corrections: Count = 0
    """Corrections in force, without first clicks."""
    first_clicks: Count = 0
    outdated: Count = 0
    """Corrections that no longer apply."""
    damage: tuple[str, ...] = ()
    """Damaged entries of its journal."""
    settings: dict[str, dict[str, JsonValue]] = {}
    """Settings of its next run that layers state, by stage."""
    poses: tuple[tuple[datetime, Amount], ...] = ()
    """End and number of fitted bodies of each run."""
    is_settled: bool = False
    """Whether `worldpose reprocess` without options has nothing to do."""

    @property
    def state(self) -> str:
        """The latest run's state, or the state before the first run."""
        if self.is_unseen:
            return "being read"
        if self.problem:
            return "unreadable"
        if self.running_since is not None:
            return "at work"
        return "not run" if self.latest is None else self.latest.state
