"""When what fails is the machines of a run, and not what it computes."""

from __future__ import annotations

from worldpose.errors import WorldposeError


class LostMachinesError(WorldposeError):
    """The Prefect server or the Dask scheduler of a run was lost; all that was finished is kept."""


def require_machines(failure: BaseException) -> None:
    """Go on only if a unit's failure is its own.

    Raises:
        LostMachinesError: the machines that the run uses are gone; its other units would fail too.
    """
    # Late: only runs that compute need them.
    import httpx
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError

    if isinstance(failure, LostMachinesError):
        return
    if isinstance(failure, FutureCancelledError | CommClosedError):
        lost = "the Dask scheduler"
    elif isinstance(failure, httpx.TransportError) or "Failed to reach API" in str(failure):
        lost = "the Prefect server"
    else:
        return
    said = str(failure) or type(failure).__name__
    raise LostMachinesError(
        f"{lost} was lost ({said}). What was finished is kept: run again when it is back."
    ) from failure
