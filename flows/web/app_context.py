"""Shared context of all pages: the project and access control."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock, Thread, Timer
from typing import Annotated, Any

from fastapi import Depends, HTTPException, Request

from data_contracts.match import Registration
from data_contracts.operations import MatchSummary, QueuedRun
from data_contracts.review import ReviewRequest
from data_contracts.run import EXIT_CODES
from data_contracts.static_calibration import ClickedMarkings
from flows.orchestration.prefect_environment import (
    CLIENT_LOGIN,
    CLOUD_LOGIN,
    has_server,
    without_secrets,
)
from flows.overview import Overview
from flows.registering import open_for_review, open_stored
from flows.review.verdicts import resume
from flows.run_record import describe_end, latest_run
from flows.service.match_runs import MatchRuns, match_runs_of
from flows.stage import Match
from flows.web.access import Access
from worldpose.review.journal import requests_by_id
from worldpose.store.paths import is_name
from worldpose.store.run_queue import ENDED, last_ended
from worldpose.store.store import Store


@dataclass(frozen=True)
class PageContext:
    """Shared context of all pages.

    `previews` has the clicks of the last preview of each camera, by match and camera, and the
    expected errors of the camera that they give [m].
    """

    store: Store
    access: Access
    previews: dict[tuple[str, str], tuple[ClickedMarkings, dict[str, float]]] = field(
        default_factory=dict
    )
    continuing: Continuing = field(init=False)
    overview: Overview = field(init=False)
    """Shared: each has the summaries of all matches in memory."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "overview", Overview(self.store))
        object.__setattr__(self, "continuing", Continuing(self.store))

    def registration(self, name: str) -> Registration:
        """Return the registration of a match, or HTTPException 404: no name becomes a path."""
        found = self.store.registration(name) if is_name(name) else None
        if found is None:
            raise HTTPException(404, "no such match")
        return found

    def readable(self, name: str) -> str:
        """Return the id of a registered match, or HTTPException as `registration`.

        It is 503 if its disk does not answer: many requests to a silent disk block all pages.
        """
        match_id = self.registration(name).spec.match_id
        if (now := self.overview.glance(match_id)).is_silent:
            raise HTTPException(503, now.problem)
        return match_id

    def match(self, name: str) -> Match:
        """Return a registered match with its current corrections; errors as of `readable`."""
        return open_for_review(self.store, self.readable(name))

    def stored_match(self, name: str) -> Match:
        """Return a match to show its results, if its folder is away too; errors as `readable`."""
        return open_stored(self.store, self.readable(name))

    def review(self, name: str, request: str) -> tuple[Match, ReviewRequest]:
        """Return a match and one of its review requests, or HTTPException 404."""
        match = self.match(name)
        asked = requests_by_id(match.journal.questions).get(request)
        if asked is None:
            raise HTTPException(404, "no such review")
        return match, asked


async def _person(request: Request) -> str:
    return str(request.state.who)


Person = Annotated[str, Depends(_person)]
"""Logged-in person: the guard refuses requests without one."""


_COMMAND = [sys.executable, "-c", "from flows.cli import main; main()", "run"]
_STAGE_LINE = re.compile(r" *[\d.]+ s  (\w+): \d+ of \d+ to compute")
_UNIT_LINE = re.compile(r" *[\d.]+ s    \S+ +[\d.]+ s .* (\d+) %((?: [\d.]+ \w+)?)$")
STORE_SECRETS = (CLIENT_LOGIN, CLOUD_LOGIN, "AWS_*", "OPENLINEAGE_*")
"""Variables that a run which the pages start gets although they hold secrets: it uses them."""
LAST_LINES = 12
"""Lines of a run's output that a page shows."""
PATIENCE_SECONDS = 15.0
"""Time in which a cancelled run ends by itself [s]."""
FRESH_SECONDS = 2.0
"""Maximum age of the state of the queue that pages show [s]."""


@dataclass
class Continuing:
    """Runs that pages start: of a served project by its deployment, as all other runs of it.

    Without a service there is no worker: the pages run one match after another, each by `worldpose
    run` in its own process, which survives the end of the pages.
    """

    store: Store
    _local: LocalRuns = field(init=False)
    _seen: _Seen | None = None
    _lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self._local = LocalRuns(self.store)

    def go_on(self, match_id: str, gates: str | None = None) -> dict[str, Any]:
        """Resume the match's suspended runs, or start one; return which of the two.

        InputError if a suspended run has undecided reviews, UnreachablePrefectError if Prefect does
        not answer.
        """
        match: Match | None = None
        while (found := self._go_on(match_id, gates, match)) is None:
            match = open_for_review(self.store, match_id)  # unlocked: its disk can be silent
        return found

    def _go_on(
        self, match_id: str, gates: str | None, match: Match | None
    ) -> dict[str, Any] | None:
        """Do as `go_on` with the opened match; return None where it is needed and not given."""
        with self._lock:
            served = match_runs_of(self.store.url)
            if served is None:
                if has_server() and not match:
                    return None
                resumed = self._resume(match) if match else None
                return resumed or self._local.go_on(match_id, gates)
            own = _open_runs(served, match_id)
            states, self._seen = {run.state for run in own}, None
            # The process of a run that was suspended a moment ago ends its workers first.
            kinds = {run["state_type"] for run in served.at_prefect(own).values()}
            is_suspended = "waiting" in states or "PAUSED" in kinds
            if is_suspended and not match:
                return None
            if is_suspended and match and (resumed := self._resume(match)):
                for run in own:
                    if run.state == "waiting":
                        served.queue.change(run, "asked", "resumed")
                self._seen = None  # another page may have looked meanwhile
                return resumed
            if states & {"asked", "killed"}:
                return {"state": "running", "how": "a run of it waits for its turn already"}
            # A run at work may have missed what was decided or corrected a moment ago.
            run = served.start(match_id, gates=gates)
            how = "once more when the run at work has ended" if states else "the deployment"
            return {"state": "running", "how": how, "prefect": served.link(run)}

    def _resume(self, match: Match) -> dict[str, Any] | None:
        """Resume the match's suspended runs; return None if there are none."""
        resumed = resume(self.store, match)
        return {"state": "resumed", "how": f"resumed {', '.join(resumed)}"} if resumed else None

    def cancel(self, match_id: str, who: str) -> bool:
        """End the match's run, or take it out of the queue; its finished results are kept.

        Return whether a run was there that pages or the service started; UnreachablePrefectError if
        Prefect does not answer.
        """
        with self._lock:
            served = match_runs_of(self.store.url)
            if served is None:
                return self._local.cancel(match_id, who)
            self._seen = None
            why = f"cancelled on the page of the match by {who}"
            own = _open_runs(served, match_id)
            return [served.cancel(run, why) for run in own].count(True) > 0

    def state(self, match_id: str) -> dict[str, Any] | None:
        """Return the state of the match's run, or of the last one if it failed or was cancelled."""
        seen = self._look()
        if seen is None:
            return self._local.state(match_id)
        own = [run for run in seen.open if run.match_id == match_id and run.state != "waiting"]
        if own:
            run = next((each for each in own if each.state == "begun"), own[0])
            beat = seen.served.queue.beat(run) if run.state == "begun" else None
            lines = [beat.doing] if beat is not None and beat.doing else []
            stage = re.match(r"[a-z_]+", lines[0]) if lines else None
            if run.state != "begun":
                others = [it for it in seen.open if it.state != "waiting" and it is not run]
                # A resumed run keeps its place: what has begun is before it too.
                first = seen.open.index(run)
                ahead = [it for it in others if it.state == "begun" or seen.open.index(it) < first]
                runs = "1 run is" if len(ahead) == 1 else f"{len(ahead)} runs are"
                lines = ["It starts in a moment."]
                if ahead:
                    lines = [f"{runs} before it."]
            return {
                "state": "running",
                "waits": run.state != "begun",
                "lines": lines,
                "percent": 0.0 if beat is None else 100.0 * beat.share,
                "prefect": seen.served.link(run),
                "stage": stage[0] if stage else "",
            }
        last = seen.ended.get(match_id)
        if last is None or last.state == "complete":
            return None
        code, message = 1, last.message
        if _ran_since(self.store, match_id, last.changed_at):
            return None
        if last.state == "cancelled":
            code, message = 130, f"{message[:1].upper()}{message[1:]}."
        record = latest_run(self.store, match_id)
        if record is not None and f"run {record.run_id} of {match_id}:" in message:
            # The flow failed because its run is not complete: the record says how it ended.
            code, message = EXIT_CODES[record.state], describe_end(record)
        link = seen.served.link(last)
        return {"state": "ended", "code": code, "lines": [message], "prefect": link}

    def running(self) -> dict[str, bool]:
        """Return the matches with a run, each with whether that waits for its turn."""
        seen = self._look()
        if seen is None:
            return self._local.running()
        begun = {run.match_id for run in seen.open if run.state == "begun"}
        own = (run.match_id for run in seen.open if run.state != "waiting")
        return {name: name not in begun for name in own}

    def links(self) -> dict[str, str]:
        """Return the page of each match's latest run at Prefect; empty without a service."""
        seen = self._look()
        if seen is None:
            return {}
        latest = {**seen.ended, **{run.match_id: run for run in seen.open}}
        return {match_id: seen.served.link(run) for match_id, run in latest.items()}

    def _look(self) -> _Seen | None:
        """Return the runs of the service, of the last seconds; None without a service."""
        served = match_runs_of(self.store.url)
        if served is None:
            return None
        seen = self._seen
        if seen is None or time.monotonic() - seen.at > FRESH_SECONDS:
            runs = served.queue.runs("queue/match")
            running = [run for run in runs if run.state not in ENDED]
            off = [run for run in runs if run.state == "cancelled" and run.pid]  # had begun
            last = sorted((*last_ended(runs), *off), key=lambda run: run.changed_at)
            ended = {run.match_id: run for run in last}
            seen = self._seen = _Seen(time.monotonic(), served, running, ended)
        return seen


def _open_runs(served: MatchRuns, match_id: str) -> list[QueuedRun]:
    """Return the runs of a match that have not ended."""
    runs = served.queue.runs(f"queue/match/{match_id}")
    return [run for run in runs if run.state not in ENDED]


def read_progress(said: str) -> dict[str, Any]:
    """Return percent of a run, and its stage with the time left, from what `worldpose run` prints.

    A unit's line ends with percent and time left of its stage and then of the run
    (`flows.cli.console`).
    """
    lines = said.splitlines()
    stages = [found[1] for each in lines if (found := _STAGE_LINE.match(each)) is not None]
    units = [found for each in lines if (found := _UNIT_LINE.match(each)) is not None]
    doing = [stages[-1].replace("_", " ")] if stages else []
    stage = stages[-1] if stages else ""
    if not units:
        return {"lines": doing, "percent": 0.0, "stage": stage}
    percent, left = float(units[-1][1]), units[-1][2].strip()
    if doing and left:
        doing = [f"{doing[0]}, {left} left of the run"]
    return {"lines": doing, "percent": percent, "stage": stage}


@dataclass(frozen=True)
class _Seen:
    """Runs of matches of the service at a time of the monotonic clock [s].

    Those that have not ended are in the order of the requests; `ended` has each match's last one.
    """

    at: float
    served: MatchRuns
    open: list[QueuedRun]
    ended: dict[str, QueuedRun]


def _ran_since(store: Store, match_id: str, ended_at: datetime) -> bool:
    """Return whether a run of the match, of these pages or not, has a record or begun since."""
    record = latest_run(store, match_id)
    is_begun = any(run.started_at > ended_at for run in store.unfinished_runs(match_id))
    return is_begun or (record is not None and record.finished_at > ended_at)


def say_cancelled(found: MatchSummary, at_work: Mapping[str, Any] | None) -> MatchSummary:
    """Return a summary; that of a match whose run a person cancelled says so, and by whom."""
    if found.kind != "stopped" or at_work is None or at_work.get("code") != 130:
        return found
    why = f"{at_work['lines'][-1]} Its finished steps are kept."
    return found.model_copy(update={"words": "cancelled", "why": why})


def _terminate(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)


@dataclass
class LocalRuns:
    """Runs of pages without a service, one after another."""

    store: Store
    _waiting: list[tuple[str, str | None]] = field(default_factory=list)
    _at_work: str | None = None
    _output: Path | None = None
    _process: subprocess.Popen[bytes] | None = None
    _cancelled_by: str = ""
    _ended: dict[str, tuple[int, Path | str, datetime]] = field(default_factory=dict)
    _lock: Lock = field(default_factory=Lock)

    def go_on(self, match_id: str, gates: str | None) -> dict[str, Any]:
        """Run the match when all earlier ones have ended, also if it is the one at work."""
        with self._lock:
            if self._at_work is None:
                self._at_work = match_id
                Thread(target=self._run_all, args=[match_id, gates], daemon=True).start()
                return {"state": "running", "how": "worldpose run"}
            if match_id not in dict(self._waiting):
                self._waiting.append((match_id, gates))
            # The run at work can have missed what was decided a moment ago.
            is_same = self._at_work == match_id
            how = "once more when the run at work has ended"
            return {"state": "running", "how": how if is_same else f"after {self._at_work}"}

    def state(self, match_id: str) -> dict[str, Any] | None:
        """Return the state of the match's last run that was started here; None without one."""
        with self._lock:
            if match_id == self._at_work:
                output = self._output
                printed = "" if output is None else output.read_text(errors="replace")
                return {"state": "running", **read_progress(printed)}
            if match_id in dict(self._waiting):
                lines = [f"The run of {self._at_work} is before it."]
                return {"state": "running", "waits": True, "lines": lines}
            ended = self._ended.get(match_id)
        if ended is None:
            return None
        code, said, ended_at = ended
        if _ran_since(self.store, match_id, ended_at):
            return None
        printed = said if isinstance(said, str) else said.read_text(errors="replace")
        lines = printed.splitlines()[-LAST_LINES:]
        return {"state": "ended", "code": code, "lines": lines}

    def running(self) -> dict[str, bool]:
        """Return the match at work and those that wait for their turn, and whether each waits."""
        with self._lock:
            at_work = {} if self._at_work is None else {self._at_work: False}
            return {**{name: True for name, _ in self._waiting}, **at_work}

    def cancel(self, match_id: str, who: str) -> bool:
        """End the match's run as Ctrl-C does, or take it out of the queue; return whether."""
        with self._lock:
            waits = match_id in dict(self._waiting)
            self._waiting = [each for each in self._waiting if each[0] != match_id]
            if is_at_work := match_id == self._at_work:
                self._cancelled_by = who
            if is_at_work and self._process is not None:
                os.killpg(self._process.pid, signal.SIGINT)
                # Some ignore it, as what is started in the background of a script.
                later = Timer(PATIENCE_SECONDS, _terminate, [self._process])
                later.daemon = True
                later.start()
            return waits or is_at_work

    def _run_all(self, match_id: str, gates: str | None) -> None:
        while True:
            ended: tuple[int, Path | str]
            try:
                ended = self._run(match_id, gates)
            except Exception as error:  # any, so that the other runs have their turn
                ended = 1, f"The run could not be started: {error}"
            with self._lock:
                self._process, self._cancelled_by = None, ""
                self._ended[match_id], self._output = (*ended, datetime.now(UTC)), None
                if not self._waiting:
                    self._at_work = None
                    return
                match_id, gates = self._waiting.pop(0)
                self._at_work = match_id

    def _run(self, match_id: str, gates: str | None) -> tuple[int, Path | str]:
        """Run a match; return its exit code, and its output's file, or who cancelled it."""
        said = Path(tempfile.mkdtemp(prefix="worldpose-run-")) / "output.txt"
        said.touch()
        with self._lock:
            self._output = said
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
                env=without_secrets(os.environ, keep=STORE_SECRETS),
            )
        with self._lock:
            self._process = process
            if self._cancelled_by:  # before it was there
                os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
        # Before the command handles it, the signal of `cancel` ends the process or Python's start.
        if code != 0 and self._cancelled_by:
            return 130, f"Cancelled on the page of the match by {self._cancelled_by}."
        return code, said
