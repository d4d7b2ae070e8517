"""A lost Prefect server or Dask scheduler is no failure of a unit."""

import httpx
import pytest
from distributed.client import FutureCancelledError
from distributed.comm.core import CommClosedError

from flows.lost_machines import LostMachinesError, require_machines
from worldpose.errors import InputError, StoreError


@pytest.mark.parametrize(
    ("failure", "lost"),
    [
        (FutureCancelledError("tracking-1", "scheduler-connection-lost"), "Dask scheduler"),
        (CommClosedError("in <TCP>"), "Dask scheduler"),
        (httpx.ConnectError("refused"), "Prefect server"),
        (RuntimeError("Failed to reach API at http://127.0.0.1:4200/api/"), "Prefect server"),
    ],
)
def test_what_is_lost_is_named_and_how_to_go_on(failure, lost):
    with pytest.raises(LostMachinesError, match=f"the {lost} was lost.*run again") as told:
        require_machines(failure)
    require_machines(told.value)  # told once


def test_a_units_own_failure_is_its_own():
    for failure in (StoreError("no space"), OSError(28, "no space"), ValueError("of a bug")):
        require_machines(failure)
    require_machines(InputError("a", expected="b", found="c", todo="d"))
