"""Shared context of all pages: the project and access control."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock, Thread
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Request

from flows.orchestration.prefect_environment import has_server
from flows.registering import open_for_review
from flows.review.verdicts import resume
from flows.stage import Match
from flows.web.access import Access
from worldpose.store import Store


@dataclass(frozen=True)
class PageContext:
    """Shared context of all pages.

    Attributes:
        store: the project.
        access: access control.
        continuing: runs started or resumed from a page.
    """

    store: Store
    access: Access
    continuing: Continuing = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "continuing", Continuing(self.store))

    def match(self, name: str) -> Match:
        """Return a registered match with its current corrections.

        Raises:
            HTTPException: 404; a name from outside never becomes a path.
        """
        if name not in self.store.matches():
            raise HTTPException(404, "no such match")
        return open_for_review(self.store, name)


def _person(request: Request) -> str:
    return str(request.state.who)


Person = Annotated[str, Depends(_person)]
"""Logged-in person: the guard refuses requests without one."""


_COMMAND = [sys.executable, "-c", "from flows.cli import main; main()", "run"]
LAST_LINES = 12
"""Lines of a run's output that a page shows."""


@dataclass
class _Run:
    process: subprocess.Popen[bytes]
    said: Path


@dataclass
class Continuing:
    """Runs started from a page: at most one per match, each in its own process.

    A run survives the end of the pages' server; a killed run is handled like any killed run.

    Attributes:
        store: the project.
    """

    store: Store
    _runs: dict[str, _Run] = field(default_factory=dict)
    _once_more: set[str] = field(default_factory=set)
    _lock: Lock = field(default_factory=Lock)

    def go_on(self, match_id: str, gates: str | None = None) -> dict[str, Any]:
        """Resume the match's suspended runs, or start `worldpose run`; return which of the two.

        Args:
            match_id: a registered match.
            gates: gate policy of a match's first run; None = the command line's default.

        Raises:
            InputError: a suspended run has undecided reviews.
        """
        with self._lock:
            if self._at_work(match_id):
                # It can have created its review requests already, and miss new verdicts.
                self._once_more.add(match_id)
                return {"state": "running", "how": "once more when the run at work has ended"}
            if has_server():
                resumed = resume(self.store, open_for_review(self.store, match_id))
                if resumed:
                    return {"state": "resumed", "how": f"resumed {', '.join(resumed)}"}
            self._start(match_id, gates)
            return {"state": "running", "how": "worldpose run"}

    def state(self, match_id: str) -> dict[str, Any] | None:
        """Return the state of the last run that was started here; None if there was none."""
        run = self._runs.get(match_id)
        if run is None:
            return None
        code = run.process.poll()
        lines = run.said.read_text(errors="replace").splitlines()[-LAST_LINES:]
        return {"state": "running" if code is None else "ended", "code": code, "lines": lines}

    def _start(self, match_id: str, gates: str | None) -> None:
        folder = Path(tempfile.mkdtemp(prefix="worldpose-run-"))
        said = folder / "output.txt"
        command = [*_COMMAND, match_id, "--project", self.store.url]
        if gates is not None:
            command += ["--gates", gates]
        with said.open("wb") as output:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._runs[match_id] = _Run(process, said)
        Thread(target=self._watch, args=[match_id, process], daemon=True).start()

    def _watch(self, match_id: str, process: subprocess.Popen[bytes]) -> None:
        """Start the run again if that was requested while it was running."""
        process.wait()
        with self._lock:
            if match_id in self._once_more:
                self._once_more.discard(match_id)
                self._start(match_id, None)

    def _at_work(self, match_id: str) -> bool:
        run = self._runs.get(match_id)
        return run is not None and run.process.poll() is None
