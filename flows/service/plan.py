"""Options of `worldpose serve`, shared by all its processes, and the secrets that some receive."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from secrets import token_urlsafe
from typing import Final
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from pydantic import Field

from data_contracts.records import Name, Record
from flows.orchestration.prefect_environment import (
    CLIENT_LOGIN,
    CLOUD_LOGIN,
    DATABASE,
    SERVER_LOGIN,
    new_login,
)
from flows.service.layout import StateFolder
from flows.web.proxy import TOKEN_LENGTH
from worldpose.errors import UsageError
from worldpose.formats.files import whole_file
from worldpose.store.blobs import storage_errors

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
    """TOML file of the people who may log in; None: every user with the token."""

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


SCHEDULED: Final = ("ingest", "reprocess")
"""Flows that run without parameters of a person."""
CRON_FIELDS: Final = 5
LOCALTIME: Final = Path("/etc/localtime")
TIMEZONE: Final = Path("/etc/timezone")


def parse_schedules(texts: Iterable[str]) -> dict[str, Schedule]:
    """Return schedules given as `FLOW=CRON`, or `FLOW=CRON TIMEZONE`, by flow.

    Without a time zone, times are those of this machine's zone. UsageError for an unknown flow or
    time zone, or no valid cron expression.
    """
    found: dict[str, Schedule] = {}
    for text in texts:
        flow, _, given = text.partition("=")
        fields = given.split()
        zone = fields.pop() if len(fields) == CRON_FIELDS + 1 else _local_timezone()
        cron = " ".join(fields)
        problem = _problem(cron, zone) if flow in SCHEDULED else repr(flow)
        if problem or flow in found:
            raise UsageError(
                f"--schedule {text}",
                expected=f"one FLOW=CRON of each of {', '.join(SCHEDULED)}; cron is minute, hour, "
                "day, month and day of the week, and a time zone can follow",
                found=problem or f"{flow} twice",
                todo='Write it as in: --schedule reprocess="0 3 * * *". In Prefect\'s dashboard, '
                "other deployments can be scheduled too.",
            )
        found[flow] = Schedule(cron=cron, timezone=zone)
    return found


def _local_timezone() -> str:
    """Return the name of this machine's time zone; UTC if it has none.

    UsageError if its times are not those of UTC, and no name of them is known.
    """
    given = os.environ.get("TZ", "").lstrip(":")
    file = Path(given or LOCALTIME)
    if not file.is_absolute():
        return given
    _, is_linked, name = os.path.realpath(file).rpartition("zoneinfo/")
    if is_linked or not file.exists():
        return name if is_linked else "UTC"
    # As in a container: a copy of a zone's file, whose name another file can tell.
    with suppress(OSError, ValueError, ZoneInfoNotFoundError):
        with file.open("rb") as content:
            offsets = _offsets(ZoneInfo.from_file(content))
        if not any(offsets):
            return "UTC"
        name = TIMEZONE.read_text(encoding="utf-8").strip()
        if _offsets(ZoneInfo(name)) == offsets:
            return name
    raise UsageError(
        "--schedule",
        expected="a time zone after the five fields",
        found=f"none, and {file} does not tell the name of this machine's",
        todo="Name it: write `0 3 * * * Europe/Berlin`.",
    )


def _offsets(zone: ZoneInfo) -> list[timedelta | None]:
    """Return the offsets from UTC in the months of this year."""
    year = datetime.now(UTC).year
    return [datetime(year, month, 1, tzinfo=zone).utcoffset() for month in range(1, 13)]


def _problem(cron: str, zone: str) -> str:
    from prefect.client.schemas.schedules import CronSchedule  # late: it takes seconds
    from pydantic import ValidationError

    try:
        CronSchedule(cron=cron, timezone=zone)
    except ValidationError as error:
        return str(error.errors()[0]["msg"]).removeprefix("Value error, ")
    return ""


ALERTS: Final = ("WORLDPOSE_ALERT_URL", "WORLDPOSE_ALERT_MAIL")
LINEAGE: Final = "OPENLINEAGE_API_KEY"
"""Key of the receiver of lineage, which the runs of the worker need."""
PAGES_TOKEN: Final = "WORLDPOSE_REVIEW_TOKEN"
METRICS_TOKEN: Final = "WORLDPOSE_METRICS_TOKEN"


@dataclass(frozen=True)
class Secrets:
    """Secrets of a served project's parts, passed as environment variables.

    `prefect` is the login of its server; None = an external server without login.
    """

    pages: str
    metrics: str
    prefect: str | None

    def of(self, part: str, plan: ServePlan) -> dict[str, str]:
        """Return only the secrets that a part needs."""
        urls = [plan.project, *([plan.bucket or ""] if part == "watch" else [])]
        cloud = [name for name in os.environ if name.startswith("AWS_")]
        names = {
            "prefect": DATABASE,
            "worker": (CLOUD_LOGIN, LINEAGE),
            "watch": (CLOUD_LOGIN, *ALERTS),
            "pages": (CLOUD_LOGIN,),
        }[part]
        if part != "prefect" and any("://" in url for url in urls):
            names = (*names, *cloud)
        found = {name: os.environ[name] for name in names if name in os.environ}
        if part == "prefect":
            found[SERVER_LOGIN] = self.prefect or ""
        elif self.prefect is not None:
            found[CLIENT_LOGIN] = self.prefect
        pages = {PAGES_TOKEN: self.pages}
        own = {"watch": {METRICS_TOKEN: self.metrics}, "pages": pages, "prefect": pages}
        return found | own.get(part, {})


def secrets_of(plan: ServePlan, pages: str) -> Secrets:
    """Return the secrets of a project before it is served; stored secrets are created once.

    UsageError if the token for metrics is short.
    """
    metrics = os.environ.get(METRICS_TOKEN)
    if metrics is not None and len(metrics) < TOKEN_LENGTH:
        raise UsageError(
            METRICS_TOKEN,
            expected=f"at least {TOKEN_LENGTH} characters",
            found=f"{len(metrics)}",
            todo="Create a token with: openssl rand -hex 16.",
        )
    state = plan.state_folder
    if metrics is None:
        metrics = kept_secret(state.metrics_token, lambda: token_urlsafe(24))
    login = os.environ.get(CLIENT_LOGIN)
    if plan.owns_prefect:
        given = os.environ.get(SERVER_LOGIN)
        login = given or kept_secret(state.prefect_login, new_login)
    return Secrets(pages, metrics, login)


def kept_secret(file: Path, make: Callable[[], str]) -> str:
    """Return a secret from a file that only this user can read; create it if missing.

    A secret that other users can read or write is replaced. Only this user can read its folder.
    """
    with storage_errors(str(file.parent)):
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        file.parent.chmod(0o700)
    try:
        with os.fdopen(os.open(file, os.O_RDONLY | os.O_NOFOLLOW)) as opened:
            known = os.fstat(opened.fileno())
            secret = opened.read().strip()
        if secret and known.st_uid == os.geteuid() and not stat.S_IMODE(known.st_mode) & 0o077:
            return secret
    except OSError:
        pass  # missing, a link, or another user's
    secret = make()
    with storage_errors(str(file)), whole_file(file) as draft:
        draft.touch(mode=0o600)
        draft.chmod(0o600)
        draft.write_text(f"{secret}\n")
    return secret
