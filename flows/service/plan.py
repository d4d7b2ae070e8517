"""Options of `worldpose serve`, shared by all its processes."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from data_contracts.records import Name, Record
from flows.service.layout import StateFolder

FLOWS = ("match", "ingest", "reprocess", "release", "finetune")
"""Flows that the Prefect server offers, known without importing Prefect."""
TITLES = {"ingest": "inbox", "reprocess": "stale matches", "finetune": "fine-tuning"}
"""Flow to the name of its runs; the runs of all other flows have the name of their match."""


def deployment_name(name: str, flow: str) -> str:
    """Return Prefect's full name of a deployment, from the `--name` of the service and the flow."""
    return f"{flow}/{name}-{flow}"


def deployment_names(name: str) -> list[str]:
    """Return the names of all deployments of a service, without those of their flows."""
    return [deployment_name(name, flow).partition("/")[2] for flow in FLOWS]


class Schedule(Record):
    """When a deployment runs."""

    cron: str
    """Minute, hour, day, month, day of the week."""
    timezone: str
    """IANA name of the time zone of these times."""


class ServePlan(Record):
    """Options of a served project; contains no secret."""

    project: str
    """Folder or URL of the store."""
    inbox: Path
    """Folder for arriving matches."""
    videos: tuple[Path, ...] = ()
    """Folders whose videos people can pick on the pages, read-only."""
    bucket: str | None = None
    """Address of an inbox in object storage, copied to the inbox folder."""
    state: Path
    """Folder of logs, alerts and the state of arrivals."""
    name: Name = "worldpose"
    """Name of the deployments and work pools; projects that share a Prefect server need their
    own."""
    prefect: str
    """Address of Prefect's API."""
    owns_prefect: bool = True
    """Whether this service starts and ends the Prefect server."""
    max_concurrent: int = Field(default=1, ge=1)
    """Matches that run at the same time; runs that wait for review do not count."""
    dask: str | None = None
    """Address of a running Dask scheduler; None: workers on this machine for each run."""
    workers: int | None = Field(default=None, ge=1)
    """Worker processes of a run on this machine; None: the cores, divided by `max_concurrent`."""
    time_limits: dict[str, float] = Field(default_factory=dict)
    """Stage to the time limit of a unit [min], if not the default."""
    host: str = "127.0.0.1"
    """Address of the pages and metrics servers."""
    names: tuple[str, ...] = ()
    """Further names of this machine in browsers and scrapers."""
    pages_port: int = 8571
    """Port of the review and status pages."""
    metrics_port: int = 8573
    """Port of the metrics for Prometheus."""
    certificate: Path | None = None
    """PEM file of the pages' certificate."""
    key: Path | None = None
    """PEM file of its private key."""
    settle_seconds: float = Field(default=30.0, ge=0)
    """A match is complete when nothing changed for so long [s]."""
    poll_minutes: float = Field(default=15.0, gt=0)
    """Interval of scheduled inbox scans, in addition to those on arrival [min]."""
    gate_hours: float = Field(default=24.0, gt=0)
    """A result that waits longer for review raises an alert [h]."""
    disk_gb: float = Field(default=10.0, ge=0)
    """Less free space than this raises an alert [GB]."""
    stall_minutes: float = Field(default=10.0, ge=0.5)
    """A run or scan without progress for so long is ended, and raises an alert [min]."""
    history_days: float = Field(default=30.0, ge=1.0)
    """A Prefect server of our own forgets ended runs after so long [d]."""
    schedules: dict[str, Schedule] = Field(default_factory=dict)
    """Flow to its schedule, beside those that people make at the Prefect server."""
    users: Path | None = None
    """TOML file of the people who may log in to the pages; None: every user with the token."""

    @property
    def state_folder(self) -> StateFolder:
        """The folder of logs, alerts and the state of arrivals."""
        return StateFolder(self.state)

    @property
    def dashboard(self) -> str:
        """Address of Prefect's dashboard."""
        return self.prefect.removesuffix("/api")

    @property
    def pages(self) -> str:
        """Address of the review pages, without a token."""
        scheme = "http" if self.certificate is None else "https"
        is_here = self.host in ("127.0.0.1", "localhost", "::1")
        name = self.host if is_here or not self.names else self.names[0]
        return f"{scheme}://{name}:{self.pages_port}"

    @property
    def match_deployment(self) -> str:
        """Name of the Prefect deployment that processes matches."""
        return deployment_name(self.name, "match")
