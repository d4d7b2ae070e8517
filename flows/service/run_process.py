"""One run of an installed flow: `python -m flows.service.run_process FLOW RUN_ID`.

The worker starts this program, never a command, code or folder that a server names. It records in
the project's queue what becomes of the run. It ends when its standard input closes.
"""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Thread
from typing import Final
from uuid import UUID

import httpx
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun
from prefect.engine import handle_engine_signals
from prefect.exceptions import Abort, ObjectNotFound, Pause
from prefect.flow_engine import run_flow

from flows.orchestration.local_cluster import LostWorkersError
from flows.orchestration.prefect_api import UnreachablePrefectError
from flows.service import deployed
from flows.service.child import end_with_parent
from flows.service.run_queue import beating, queue_of_parameters, queued_run
from worldpose.store.run_queue import ENDED
from worldpose.store.store import Store

LOST: Final = (LostWorkersError, UnreachablePrefectError, ObjectNotFound, httpx.HTTPError)
"""Errors of a run whose Prefect server or Dask scheduler is gone or busy: it restarts."""


def main(flow: str, run_id: UUID) -> None:
    """Run a flow of `flows.service.deployed` with the parameters of a run at the server."""
    with handle_engine_signals(run_id):
        with get_client(sync_client=True) as client:
            at_prefect = client.read_flow_run(run_id)
            queue = queue_of_parameters(at_prefect.parameters)
            run = queue.take(queued_run(flow, at_prefect.model_dump(mode="json")))
            states = client.read_flow_run_states(run_id) if run.state in ENDED else []
        # "Late" is said by Prefect itself.
        asked = (each for each in states if each.is_scheduled() and each.name != "Late")
        if any(each.timestamp > run.changed_at for each in asked):
            queue.change(run, "asked", "retried at Prefect")
        begun = None if _is_off(at_prefect) else queue.begin(run, str(run_id))
        if begun is None:  # it was cancelled after the worker took it
            raise Abort
        run = begun
        try:
            known = Store(queue.blobs).registration(run.match_id) if run.match_id else None
            with beating(queue, run, None if known is None else Path(known.folder)):
                run_flow(getattr(deployed, flow), flow_run=at_prefect)
        except Abort:  # it was cancelled at Prefect; the worker records that
            raise
        except Pause:
            queue.change(run, "waiting", "for review")
            raise
        except LOST as error:
            queue.kill(run, f"{type(error).__name__}: {error}")
            raise
        except Exception as error:
            queue.change(run, "failed", str(error) or type(error).__name__)
            raise
        queue.change(run, "complete")


def _is_off(at_prefect: FlowRun) -> bool:
    state = at_prefect.state
    return state is not None and (state.is_cancelled() or state.is_cancelling())


if __name__ == "__main__":
    Thread(target=end_with_parent, daemon=True).start()
    main(sys.argv[1], UUID(sys.argv[2]))
