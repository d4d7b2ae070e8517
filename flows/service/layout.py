"""Where a served project keeps its state, and what its parts are called."""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from data_contracts.operations import Arrival, Priority, Serving
from worldpose.errors import UsageError
from worldpose.formats import whole_file
from worldpose.store.blobs import storage_errors

PRIORITIES: Final[tuple[Priority, ...]] = ("urgent", "normal", "background")
"""First to last; `INBOX/urgent` and `INBOX/background` take matches of those."""


@dataclass(frozen=True)
class StateFolder:
    """The folder of a served project's state: no result is in it, and no secret but `secrets/`.

    Attributes:
        folder: `<project>/operations`, or as it was given.
    """

    folder: Path

    @property
    def serving(self) -> Path:
        """What is being served."""
        return self.folder / "serve.json"

    @property
    def logs(self) -> Path:
        """What each process said."""
        return self.folder / "logs"

    @property
    def alerts(self) -> Path:
        """Which alerts were sent and still hold."""
        return self.folder / "alerts.json"

    def read_serving(self) -> Serving | None:
        """What is served, or was last."""
        try:
            return Serving.model_validate_json(self.serving.read_bytes())
        except FileNotFoundError:
            return None

    def write_serving(self, serving: Serving) -> None:
        """Say what is served."""
        with whole_file(self.serving) as draft:
            draft.write_text(serving.model_dump_json(indent=2) + "\n")

    def arrivals(self) -> dict[str, Arrival]:
        """What is known of the inbox, by name."""
        found = {}
        for file in sorted((self.folder / "arrivals").glob("*.json")):
            try:
                arrival = Arrival.model_validate_json(file.read_bytes())
            except (FileNotFoundError, ValidationError):
                continue  # forgotten meanwhile, or damaged: then it is looked at as a new one
            found[arrival.name] = arrival
        return found

    def write_arrival(self, arrival: Arrival) -> None:
        """Keep what is known of one entry; its name never becomes a path."""
        file = self._arrival_file(arrival.name)
        with storage_errors(str(file)), whole_file(file) as draft:
            draft.write_text(arrival.model_dump_json(indent=2) + "\n")

    def end_orderly(self) -> None:
        """All processes of the service were ended on purpose: that is no death of what they did."""
        for arrival in self.arrivals().values():
            if arrival.is_begun:
                self.write_arrival(arrival.model_copy(update={"is_begun": False}))

    def forget_arrival(self, name: str) -> None:
        """Its entry is gone from the inbox."""
        self._arrival_file(name).unlink(missing_ok=True)

    def _arrival_file(self, name: str) -> Path:
        return self.folder / "arrivals" / f"{hashlib.sha256(name.encode()).hexdigest()[:16]}.json"

    @property
    def prefect_login(self) -> Path:
        """What clients log in to our own Prefect server with; for this user alone."""
        return self.folder / "secrets" / "prefect"

    @property
    def metrics_token(self) -> Path:
        """What Prometheus asks for figures with; for this user alone."""
        return self.folder / "secrets" / "metrics"

    @contextmanager
    def only_one(self, what: str, *, wait: bool) -> Iterator[bool]:
        """Hold the lock `what`; gives whether it is held, which without `wait` it may not be.

        The lock ends with the process, however that ends.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / f"{what}.lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError:
                yield False
                return
            yield True


def state_folder(project: str, given: Path | None) -> StateFolder:
    """Where the state of a served project lies.

    Raises:
        UsageError: a project on object storage, and no folder is named.
    """
    if given is not None:
        return StateFolder(given.resolve())
    if "://" in project:
        raise UsageError(
            f"worldpose serve --project {project}",
            expected="--state, a folder on this machine for Prefect's database and logs",
            found="none",
            todo="Name one, as in --state /var/lib/worldpose.",
        )
    return StateFolder(Path(project).resolve() / "operations")


def served_state(url: str) -> StateFolder:
    """Where the state of a project lies for a process of `worldpose serve`, or for any other."""
    given = os.environ.get("WORLDPOSE_STATE")
    if given is None and "://" in url:
        return StateFolder(Path("/nonexistent"))  # nothing is served from this machine
    return state_folder(url, None if given is None else Path(given))


def is_alive(pid: int) -> bool:
    """Is there such a process on this machine."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
