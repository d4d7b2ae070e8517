"""Setup and teardown of a Dask worker: `dask worker --preload tasks.preload`.

Runs with their own workers use it. It is the first preloaded module: garbage collection, a fifth of
the import time, is disabled until all modules are imported.
"""

from __future__ import annotations

import gc
import os
import threading

import dask
from distributed import Scheduler, Worker

from tasks.tracing import flush_spans, start_tracing
from worldpose.compiled import load_compiler

gc.disable()
# Before Prefect is imported with the first task: it would send telemetry.
os.environ.setdefault("DO_NOT_TRACK", "1")
# Dask would sample every worker's stack 100 times per second for a page that is not served, and
# keep the samples for an hour, a few MB per run.
dask.config.set({"distributed.worker.profile.enabled": False})


def dask_setup(node: Worker | Scheduler) -> None:
    """Enable garbage collection again, except for the modules imported so far.

    The HTTP server is closed: it would show the computation to every user of the machine.
    """
    node.http_server.stop()
    start_tracing()
    gc.freeze()
    gc.enable()
    if isinstance(node, Worker):
        # Until the flow sends its first task.
        threading.Thread(target=load_compiler, daemon=True).start()


def dask_teardown(node: Worker | Scheduler) -> None:
    """Send the last spans; leave all memory to the end of the process, which saves one second."""
    flush_spans()
    gc.freeze()
