"""What a Dask worker does around its work: `dask worker --preload tasks.preload`.

Runs that start workers of their own do so. They name it first of what workers import when they
start: until they have, no garbage is collected, which takes a fifth of those seconds.
"""

from __future__ import annotations

import gc
import os

from distributed import Scheduler, Worker

gc.disable()
# Before Prefect is imported with the first task: it would report its use.
os.environ.setdefault("DO_NOT_TRACK", "1")


def dask_setup(node: Worker | Scheduler) -> None:
    """Collect garbage again, but for the modules that are imported by now.

    The server for HTTP is closed: it would tell every user of the machine what is computed.
    """
    node.http_server.stop()
    gc.freeze()
    gc.enable()


def dask_teardown(node: Worker | Scheduler) -> None:
    """Leave all there is to the end of the process: freeing it piece by piece takes a second."""
    gc.freeze()
