"""Detection of failures of a run's machines, as opposed to failures of its computation."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from worldpose.errors import StoreError, WorldposeError

LITTLE_BYTES = 1 << 20
"""Free disk space below which Prefect's database cannot complete a transaction [byte]."""


class LostWorkersError(WorldposeError):
    """The Prefect server or the Dask scheduler of a run was lost; finished results are kept."""


def require_room(failure: BaseException, project: str) -> None:
    """Raise StoreError if a failure of Prefect was caused by a full disk; else return.

    Prefect reports database failures only as `500`. Its database is in the project, or in a
    temporary folder.

    Raises:
        StoreError: the disk of the store or of Prefect's database is full.
    """
    if isinstance(failure, StoreError):
        return
    folders = [Path(tempfile.gettempdir())]
    if "://" not in project:
        folders.insert(0, Path(project))
    for folder in folders:
        free = shutil.disk_usage(folder).free
        if free < LITTLE_BYTES:
            raise StoreError(
                f"{folder}: No space left on device ({free} bytes are free), where Prefect keeps "
                "its database. Free space there and run again; published results are untouched."
            ) from failure


def require_workers(failure: BaseException) -> None:
    """Raise LostWorkersError if a unit failed because its machines are gone; else return.

    Raises:
        LostWorkersError: the run's machines are gone; its other units would fail too.
    """
    # Imported here: only runs that compute need them.
    import httpx
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    if isinstance(failure, LostWorkersError):
        return
    if isinstance(failure, FutureCancelledError | CommClosedError):
        lost = "the Dask scheduler"
    elif isinstance(failure, httpx.TransportError) or "Failed to reach API" in str(failure):
        lost = "the Prefect server"
    else:
        return
    said = str(failure) or type(failure).__name__
    raise LostWorkersError(
        f"{lost} was lost ({said}). Finished results are kept: run again when it is back."
    ) from failure
