"""One process of `worldpose serve`: `python -m flows.service.child PART PLAN`.

It ends when its standard input closes, and so do all processes that it started: however the service
is killed, no process is left.
"""

from __future__ import annotations

import logging
import os
import sys
import threading

from flows.service.plan import ServePlan
from flows.web.access import Access, access_for
from worldpose.errors import WorldposeError


def main() -> None:
    """Run one part until standard input closes."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    part, plan = sys.argv[1], ServePlan.model_validate_json(sys.argv[2])
    logging.basicConfig(format="%(asctime)s  %(message)s", level=logging.WARNING)
    for name in ("worldpose.operations", "worldpose.pages"):
        logging.getLogger(name).setLevel(logging.INFO)
    try:
        PARTS[part](plan)
    except WorldposeError as error:
        sys.stderr.write(f"error: {error}\n")
        sys.stderr.flush()
        os._exit(1)  # the thread that reads standard input would keep the interpreter alive


def prefect(plan: ServePlan) -> None:
    """Run Prefect's server: API, services and dashboard."""
    from urllib.parse import urlsplit

    from flows.orchestration.prefect_server import serve

    address = urlsplit(plan.prefect)
    access = _access(plan, secure=False)  # no TLS: only this machine reaches it
    serve(address.hostname or "127.0.0.1", address.port or 80, (), access)


def worker(plan: ServePlan) -> None:
    """Create the deployments, and run their flows."""
    import anyio

    from flows.service.deployments import install, pools
    from flows.service.recovery import recover
    from flows.service.worker import work

    installed = install(plan)
    recover(plan, at_start=True)
    anyio.run(work, pools(plan), installed)


def watch(plan: ServePlan) -> None:
    """Watch inbox, alerts and lost runs, and serve metrics for Prometheus."""
    from flows.service.watching import watch as watch_all

    watch_all(plan)


def pages(plan: ServePlan) -> None:
    """Serve the review pages and the status page until this process ends."""
    from flows.web.app import serve
    from flows.web.intake import Intake

    access = _access(plan, secure=plan.certificate is not None)
    tls = None
    if plan.certificate is not None and plan.key is not None:
        tls = (plan.certificate, plan.key)
    intake = Intake(plan.inbox, plan.videos)
    serve(plan.project, access, host=plan.host, port=plan.pages_port, tls=tls, intake=intake)


def _access(plan: ServePlan, *, secure: bool) -> Access:
    """Return what a session opens: the same at the pages and at Prefect's dashboard."""
    return access_for(
        plan.host,
        token=os.environ.pop("WORLDPOSE_REVIEW_TOKEN"),  # hide it from runs that pages start
        names=plan.names,
        secure=secure,
        users=plan.users,
        ended=plan.state_folder.ended_sessions,
    )


PARTS = {"prefect": prefect, "worker": worker, "watch": watch, "pages": pages}
"""Functions of the parts, in start order."""


def end_with_parent() -> None:
    """End this process and all that it started when its standard input closes."""
    while os.read(0, 1024):  # a buffered read would hold a lock that the interpreter's end needs
        continue
    import psutil

    for process in psutil.Process().children(recursive=True):
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue
    os._exit(0)


if __name__ == "__main__":
    main()
