"""State folder of a served project, and the names of its parts."""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from data_contracts.operations import Arrival, Priority, Serving
from flows.orchestration.prefect_environment import CLIENT_LOGIN, SERVER_LOGIN
from worldpose.errors import UsageError
from worldpose.formats.files import whole_file
from worldpose.store.blobs import storage_errors
from worldpose.store.runs import hold_lock

PRIORITIES: Final[tuple[Priority, ...]] = ("urgent", "normal", "background")
"""First to last; `INBOX/urgent` and `INBOX/background` set the priority of their matches."""
DISK_SECONDS: Final = 30.0
"""Time in which the disk of a project or an inbox must answer a command."""


@dataclass(frozen=True)
class StateFolder:
    """State folder of a served project: it holds no results, and secrets only in `secrets/`."""

    folder: Path

    @property
    def serving(self) -> Path:
        """File with the plan being served."""
        return self.folder / "serve.json"

    @property
    def logs(self) -> Path:
        """Folder with the log of each process."""
        return self.folder / "logs"

    @property
    def alerts(self) -> Path:
        """File with the sent alerts that still hold."""
        return self.folder / "alerts.json"

    def read_serving(self) -> Serving | None:
        """Return the plan being served, or the last one."""
        try:
            return Serving.model_validate_json(self.serving.read_bytes())
        except FileNotFoundError:
            return None

    def write_serving(self, serving: Serving) -> None:
        """Write the plan being served."""
        with whole_file(self.serving) as draft:
            draft.write_text(serving.model_dump_json(indent=2) + "\n")

    def arrivals(self) -> dict[str, Arrival]:
        """Return the known state of the inbox, by name."""
        found = {}
        for file in sorted((self.folder / "arrivals").glob("*.json")):
            with suppress(FileNotFoundError):  # removed meanwhile
                status = file.stat()  # it is replaced by another file; each is read once
                arrival = _read_arrival(file, status.st_mtime_ns, status.st_ino)
                if arrival is not None:
                    found[arrival.name] = arrival
        return found

    def write_arrival(self, arrival: Arrival) -> None:
        """Write the state of one entry; its name never becomes a path."""
        file = self._arrival_file(arrival.name)
        with storage_errors(str(file)), whole_file(file) as draft:
            draft.write_text(arrival.model_dump_json(indent=2) + "\n")

    def end_orderly(self) -> None:
        """Note that all processes ended on purpose: such an end does not count as a crash."""
        for arrival in self.arrivals().values():
            if arrival.is_begun:
                self.write_arrival(arrival.model_copy(update={"is_begun": False}))

    def forget_arrival(self, name: str) -> None:
        """Remove the state of an entry that is gone from the inbox."""
        self._arrival_file(name).unlink(missing_ok=True)

    def _arrival_file(self, name: str) -> Path:
        return self.folder / "arrivals" / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.json"

    @property
    def prefect_login(self) -> Path:
        """Login of clients at our own Prefect server; readable by this user only."""
        return self.folder / "secrets" / "prefect"

    def client_login(self, serving: Serving) -> str | None:
        """Return the login of clients at the server of a project; None if it is not known."""
        if not serving.owns_prefect or "WORLDPOSE_STATE" in os.environ:  # a part of the service
            return os.environ.get(CLIENT_LOGIN)
        try:
            return os.environ.get(SERVER_LOGIN) or self.prefect_login.read_text().strip()
        except OSError:
            return None  # the server's refusal then says so

    @property
    def alert_settings(self) -> Path:
        """The operator's file with the channels of alerts; readable by this user only."""
        return self.folder / "secrets" / "alerts.toml"

    @property
    def metrics_token(self) -> Path:
        """Token for Prometheus; readable by this user only."""
        return self.folder / "secrets" / "metrics"

    @property
    def ended_sessions(self) -> Path:
        """Folder of the sessions after logout, which pages and Prefect's server share."""
        return self.folder / "secrets" / "ended"

    @contextmanager
    def only_one(self, what: str, *, wait: bool) -> Iterator[bool]:
        """Hold the lock `what`; yield whether it was acquired, as `hold_lock`."""
        with hold_lock(self.folder / f"{what}.lock", wait=wait) as is_held:
            yield is_held

    def is_held(self, what: str) -> bool:
        """Return whether a process holds the lock `what`; a reader needs no right to write."""
        try:
            with (self.folder / f"{what}.lock").open() as lock:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            return False
        except OSError:  # held, or of another user's alone
            return True
        return False


@lru_cache(maxsize=10_000)
def _read_arrival(file: Path, changed_ns: int, number: int) -> Arrival | None:
    """Return the state of an entry in a version of its file; None if that is damaged."""
    try:
        return Arrival.model_validate_json(file.read_bytes())
    except ValidationError:
        return None  # then it counts as a new one


def state_folder(project: str, given: Path | None) -> StateFolder:
    """Return the state folder of a served project; UsageError on object storage without one."""
    if given is not None:
        return StateFolder(given.resolve())
    if "://" in project:
        raise UsageError(
            f"worldpose serve --project {project}",
            expected="--state, a folder on this machine for Prefect's database and logs",
            found="none",
            todo="Name a folder, as in --state /var/lib/worldpose.",
        )
    return StateFolder(Path(project).resolve() / "operations")


def served_state(url: str) -> StateFolder:
    """Return the state folder of a project for a process of `worldpose serve`, or any other."""
    given = os.environ.get("WORLDPOSE_STATE")
    if given is None and "://" in url:
        return StateFolder(Path("/nonexistent"))  # this machine serves no project
    return state_folder(url, None if given is None else Path(given))


def disk_answers(path: Path) -> bool:
    """Return whether the disk of a path answers in time; an error is an answer too.

    A file is read, a folder is listed. The process that asks it is left behind: no signal ends one
    that waits for a disk.
    """
    nothing, ask = subprocess.DEVNULL, ["sh", "-c", 'cat -- "$0"; ls -f -- "$0"', str(path)]
    asking = subprocess.Popen(ask, stdin=nothing, stdout=nothing, stderr=nothing)
    try:
        asking.wait(DISK_SECONDS)
    except subprocess.TimeoutExpired:
        return False
    return True


def is_alive(pid: int) -> bool:
    """Return whether there is such a process on this machine."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
