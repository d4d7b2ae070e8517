"""When what fails is the machines of a run, and not what it computes."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from worldpose.errors import StoreError, WorldposeError

LITTLE_BYTES = 1 << 20
"""With less than this free [byte], Prefect's database cannot take a transaction."""


class LostWorkersError(WorldposeError):
    """The Prefect server or the Dask scheduler of a run was lost; all that was finished is kept."""


def require_room(failure: BaseException, project: str) -> None:
    """Go on only if a failure of Prefect, or of what starts it, is not that of a full disk.

    Args:
        failure: what was raised; Prefect says no more of its database than `500`.
        project: folder or URL of the store; Prefect's database lies there, or in a passing folder.

    Raises:
        StoreError: the disk of one of them is full.
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
    """Go on only if a unit's failure is its own.

    Raises:
        LostWorkersError: the machines that the run uses are gone; its other units would fail too.
    """
    # Late: only runs that compute need them.
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
        f"{lost} was lost ({said}). What was finished is kept: run again when it is back."
    ) from failure
