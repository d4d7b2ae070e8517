"""Recovery of runs from the project's queue: what is due has a run at Prefect, what hangs is ended.

An automation of Prefect on its heartbeats would not work: it uses events, not states, and cannot
tell a suspended run from a killed one. Prefect's database may lack any run.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import signal
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import psutil

from data_contracts.operations import QueuedRun
from flows.orchestration.prefect_api import UnreachablePrefectError, of_types, parse_time
from flows.progress import format_duration
from flows.service.alerts import Alert, AlertKind
from flows.service.health import check_worker
from flows.service.layout import is_alive
from flows.service.match_runs import MatchRuns
from flows.service.plan import ServePlan, deployment_names
from flows.service.run_queue import FIXED, find_process, queued_run
from worldpose.errors import InputError
from worldpose.store.run_queue import ENDED, RunQueue, queue_of
from worldpose.store.store import Store

STARTING: Final = timedelta(minutes=5)
"""Maximum time from the start of a run's process until the run is active, on an overloaded
machine."""
SOON: Final = timedelta(minutes=1)
"""A run that is due later waits for its time; if it was due before, the clock was set back."""
ACTIVE: Final = ("SCHEDULED", "PENDING", "RUNNING", "CANCELLING", "PAUSED")

LOG = logging.getLogger("worldpose.operations")

PrefectRun = Mapping[str, Any]  # as Prefect's API describes it


def recover(plan: ServePlan, *, at_start: bool = False) -> list[str]:
    """Start runs again that were killed, or that Prefect has lost; return their names.

    One process at a time recovers; a second one returns at once. At the start of the worker, runs
    that seem to start were killed with the previous one. InputError if the project's disk is away;
    nothing is written in its place.
    """
    Store.open(plan.project)
    with plan.state_folder.only_one("recovery", wait=at_start) as is_alone:
        if not is_alone:
            return []
        runs = MatchRuns.of_plan(plan)
        adopt_due(runs)
        open_runs = runs.queue.open_runs()
        there = runs.at_prefect(open_runs) if open_runs else {}
        patience = timedelta(0) if at_start and plan.owns_prefect else STARTING
        again = []
        for run in open_runs:
            try:
                if _recover(plan, runs, run, there.get(run.flow_run), patience):
                    again.append(run.name)
            except UnreachablePrefectError as error:
                if error.status is None or error.status >= 500:
                    raise
                LOG.warning("%s cannot be recovered: %s", run.name, error)  # the others can
        return again


def adopt_due(runs: MatchRuns) -> None:
    """Take runs into the queue that schedules and people made at Prefect, and that are due.

    Of runs that a schedule missed, the last one with the same parameters stands for all; what a
    deployment decides does not count.
    """
    known = {run.flow_run: run for run in runs.queue.runs()}  # first: what is due can end meanwhile
    kinds = of_types("SCHEDULED", "PENDING", "RUNNING")
    passed = {"before_": datetime.now(UTC).isoformat()}
    due = runs.runs(deployment_names(runs.name), state=kinds, expected_start_time=passed)
    last: dict[object, dict[str, Any]] = {}
    for run in sorted(due, key=lambda run: parse_time(run["expected_start_time"])):
        if "auto-scheduled" in run["tags"] and run["state_name"] in ("Scheduled", "Late"):
            own = {name: it for name, it in run["parameters"].items() if name not in FIXED}
            same = (run["deployment_id"], json.dumps(own, sort_keys=True))
            if (missed := last.get(same)) is not None:
                why = "it was missed; a later run stands for it"
                LOG.info("%s: %s", missed["name"], why)
                runs.set_state(missed["id"], "CANCELLED", why)
            last[same] = run
        else:
            last[run["id"]] = run
    for run in last.values():
        ended = known.get(run["id"])
        if ended is None:
            try:
                runs.queue.take(queued_run(runs.ask(f"/flows/{run['flow_id']}")["name"], run))
            except (InputError, ValueError) as error:  # as a parameter that is no JSON
                runs.set_state(run["id"], "FAILED", f"it cannot be taken: {error}")
            continue
        if ended.state in ("failed", "cancelled") and run["state_type"] == "RUNNING":
            kind = "CRASHED" if ended.state == "failed" else "CANCELLED"
            runs.set_state(run["id"], kind, ended.message)  # else it would keep its place
            continue
        if ended.state in ENDED and run["state_type"] == "SCHEDULED":
            is_late = ended.state == "cancelled" and run["state_name"] == "Late"  # not by a person
            if parse_time(run["state"]["timestamp"]) > ended.changed_at and not is_late:
                runs.queue.change(ended, "asked", "retried at Prefect")
            elif ended.state == "cancelled":  # while Prefect did not answer
                runs.set_state(run["id"], "CANCELLED", ended.message)


def _recover(
    plan: ServePlan, runs: MatchRuns, run: QueuedRun, there: PrefectRun | None, patience: timedelta
) -> bool:
    """Bring a run that has not ended forward; return whether it was started again."""
    if run.state == "begun":
        is_elsewhere = not plan.owns_prefect and run.host != platform.node()
        if is_elsewhere or find_process(run.pid, run.flow_run) is not None:
            return False
    kind = None if there is None else there["state_type"]
    is_over = there is not None and kind not in ACTIVE
    killed: QueuedRun | None = run
    why = (there or {}).get("state", {}).get("message") or "cancelled at Prefect"
    if run.state == "begun":
        if kind == "PAUSED":  # suspended, and killed before the queue was told
            runs.queue.change(run, "waiting", "for review")
            return False
        if kind == "CANCELLING":
            runs.set_state(run.flow_run, kind := "CANCELLED", why)
        else:
            has_worker = find_process(run.worker_pid, "flows.service.child") is not None
            killed = runs.queue.kill(run, "its process was killed", by_service=not has_worker)
    elif run.state == "asked" and is_over and kind != "CANCELLED":
        killed = runs.queue.kill(run, str((there or {})["state"]["message"]))
    if killed is None:
        return False
    if kind == "CANCELLED":
        runs.queue.change(killed, "cancelled", why)
        return False
    if killed.state == "failed":
        if there is not None and not is_over:
            runs.set_state(run.flow_run, "CRASHED", killed.message)
        return False
    if killed.state == "waiting" and kind in ("SCHEDULED", "PENDING"):
        runs.queue.change(killed, "asked", "resumed")
    # A scan has the options of the service as a parameter, and the worker takes its own alone.
    own = plan.model_dump(mode="json")
    is_former = there is not None and not is_over and there["parameters"].get("plan", own) != own
    has_run = killed.state != "killed" and there is not None and not is_over and not is_former
    if has_run and not _is_stuck(killed, there, patience, has_our_clock=plan.owns_prefect):
        return False
    _start_again(runs, killed, there, is_former)
    return True


def _start_again(
    runs: MatchRuns, run: QueuedRun, there: PrefectRun | None, is_former: bool
) -> None:
    """Make a run due at Prefect; the queue says so first. One with former options is replaced."""
    former = "the options of the service have changed"
    why = run.message or (former if is_former else "Prefect had lost it")
    asked = runs.queue.change(run, "asked", why)
    if asked is None:
        return
    LOG.warning("%s: %s; it restarts", run.name, why)
    flow_run = run.flow_run
    if there is not None and not is_former:
        runs.set_state(flow_run, "SCHEDULED", why, "AwaitingRetry")
    else:
        key = f"queue-{run.id}.{asked.number}"
        flow_run = runs.create_run(run.flow, run.name, run.parameters, run.priority, key)["id"]
        runs.queue.change(asked, "asked", why, flow_run=flow_run)
    if is_former:
        runs.set_state(
            run.flow_run, "CANCELLED", f"{former}; a run with the new ones stands for it"
        )
    if (now := runs.queue.latest(asked)).state == "cancelled":  # meanwhile, by a person
        runs.set_state(flow_run, "CANCELLED", now.message)


def _is_stuck(
    run: QueuedRun, there: PrefectRun | None, patience: timedelta, *, has_our_clock: bool
) -> bool:
    """Return whether a queued run cannot begin.

    A run stays in a starting state if its process was killed while the server was not reachable or
    its disk was full: it would occupy a slot of the pool forever. After the clock was set back, a
    run would wait for its former time.
    """
    if run.state != "asked" or there is None:
        return False
    now, due = datetime.now(UTC), there["next_scheduled_start_time"]
    if there["state_type"] == "SCHEDULED":
        return bool(due) and parse_time(due) > now + SOON
    pid = str(there["infrastructure_pid"] or "")
    has_process = pid.isdigit() and is_alive(int(pid))
    age = now - parse_time(there["state"]["timestamp"])
    # A clock that was set back makes the time one to come; so does that of another machine.
    return not has_process and (abs(age) if has_our_clock else age) > patience


@dataclass
class Liveness:
    """Notices runs without progress and steps of the clock, and ends what hangs.

    `_since` has what identifies the progress of each run, and since when it is so [s]; `_held` has
    alerts by their keys, with the time at which they end [s].
    """

    plan: ServePlan
    _since: dict[str, tuple[object, float]] = field(default_factory=dict)
    _held: dict[str, tuple[Alert, float]] = field(default_factory=dict)
    _ahead: float | None = None
    _looked: float = 0.0

    @property
    def alerts(self) -> list[Alert]:
        """The alerts that hold."""
        return [alert for alert, _ in list(self._held.values())]

    def look(self, now: float, wall: float) -> None:
        """End runs that make no progress, and the worker if it takes none.

        Now is of the monotonic clock [s], `wall` of the machine's [s]. InputError as of `recover`.
        """
        Store.open(self.plan.project)
        self._held = {key: each for key, each in self._held.items() if each[1] > now}
        if now - self._looked > 120.0:  # the machine was asleep, and so were the runs
            self._since.clear()
        self._looked = now
        step, self._ahead = wall - now - (self._ahead or wall - now), wall - now
        if abs(step) > 60.0:  # a time service slews smaller ones
            text = f"the clock of this machine was set {'back' if step < 0 else 'forward'} by "
            text += f"{format_duration(abs(step))}; is its time service at work?"
            self._hold("clock_stepped", f"clock_stepped/{wall:.0f}", text, now + 86400.0)
        queue, limit = queue_of(self.plan.project), 60.0 * self.plan.stall_minutes
        with self.plan.state_folder.only_one("recovery", wait=True):
            open_runs, before = queue.open_runs(), self._since
            self._since = {
                name: before[name] if name in before and before[name][0] == doing else (doing, now)
                for name, doing in self._progress(open_runs).items()
            }
            still = [
                run
                for run in open_runs
                if run.id in self._since and now - self._since[run.id][1] > limit
            ]
            for run in still:
                if run.state == "begun":
                    _end_stalled(queue, run, self.plan.stall_minutes)
        late = [run for run in still if run.state == "asked"]
        if late:
            text = f"{len(late)} runs, first {late[0].name}, have been due for "
            text += f"{self.plan.stall_minutes:g} min, and nothing begins them. Is a deployment, "
            text += "queue or pool paused at Prefect? `worldpose serve --check` looks at the worker"
            self._hold("run_late", "run_late", text, now + limit)
            self._end_silent_worker()

    def _progress(self, open_runs: Iterable[QueuedRun]) -> dict[str, object]:
        """Return what changes when a run makes progress, of those that should make some."""
        queue, places = queue_of(self.plan.project), {True: 1, False: self.plan.max_concurrent}
        busy = Counter(run.flow == "ingest" for run in open_runs if run.state == "begun")
        found: dict[str, object] = {}
        for run in open_runs:
            pool = run.flow == "ingest"
            if run.state == "begun":
                beat = queue.beat(run)
                found[run.id] = (run.number, beat and beat.number)
            elif run.state == "asked" and busy[pool] < places[pool]:
                found[run.id] = run.number
        return found

    def _hold(self, kind: AlertKind, key: str, text: str, until: float) -> None:
        self._held[key] = (Alert(key, kind, text, f"{self.plan.pages}/status"), until)

    def _end_silent_worker(self) -> None:
        """Kill the worker if Prefect does not hear of it: it restarts."""
        prefect, serving = MatchRuns.of_plan(self.plan), self.plan.state_folder.read_serving()
        if serving is None or check_worker(prefect, self.plan.name).is_well:
            return
        LOG.warning("the worker gives no sign of life; it is killed, and restarts")
        with suppress(ProcessLookupError):
            os.kill(serving.services["worker"].pid, signal.SIGKILL)
        self._since.clear()  # the next one has its own time


def _end_stalled(queue: RunQueue, run: QueuedRun, minutes: float) -> None:
    """Kill a run that makes no progress: it restarts, or has failed for good."""
    beat, process = queue.beat(run), find_process(run.pid, run.flow_run)
    doing = (beat.doing if beat is not None else "") or "before its first stage"
    why = f"no progress for {minutes:g} min, {doing}: does a disk, or the network, not answer?"
    killed = queue.kill(run, why, stalled=why)
    if killed is None:
        return
    LOG.warning("%s: %s; it is killed", run.name, why)
    if process is None:  # on a machine that is gone
        return
    with suppress(psutil.NoSuchProcess):
        family = [process, *process.children(recursive=True)]
        for each in family:
            with suppress(psutil.NoSuchProcess):
                each.kill()
        _, left = psutil.wait_procs(family[:1], timeout=5.0)
        if left and killed.state != "failed":
            queue.change(killed, "failed", f"{why} Process {process.pid} cannot be killed")
