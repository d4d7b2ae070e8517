"""One run of an installed flow: `python -m flows.service.run_process FLOW RUN_ID`.

The worker starts this program, never a command, code or folder that a server names. It ends when
its standard input closes.
"""

from __future__ import annotations

import sys
from threading import Thread
from uuid import UUID

from prefect.client.orchestration import get_client
from prefect.engine import handle_engine_signals
from prefect.flow_engine import run_flow

from flows.service import deployed
from flows.service.child import end_with_parent


def main(flow: str, run_id: UUID) -> None:
    """Run a flow of `flows.service.deployed` with the parameters of a run at the server."""
    with handle_engine_signals(run_id):
        with get_client(sync_client=True) as client:
            run = client.read_flow_run(run_id)
        run_flow(getattr(deployed, flow), flow_run=run)


if __name__ == "__main__":
    Thread(target=end_with_parent, daemon=True).start()
    main(sys.argv[1], UUID(sys.argv[2]))
