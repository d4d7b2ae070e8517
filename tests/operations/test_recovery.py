"""Which runs begin again by themselves."""

from uuid import uuid4

import pytest
from prefect.client.schemas.objects import FlowRun
from prefect.states import Completed, Crashed, Failed

from flows.operations.recovery import MOST_BEGINNINGS, may_begin_again

LOST = "Flow run encountered an exception: LostMachinesError: the Dask scheduler was lost"


@pytest.mark.parametrize(
    ("state", "again"),
    [
        (Crashed(message="its process was killed"), True),
        (Failed(message=LOST), True),
        (Failed(message="Flow run encountered an exception: IncompleteRunError: 1 failed"), False),
        (Completed(), False),
    ],
)
def test_runs_begin_again_that_ended_by_no_fault_of_their_own(state, again):
    run = FlowRun(flow_id=uuid4(), state=state, state_type=state.type, run_count=1)
    assert may_begin_again(run) is again
    tired = run.model_copy(update={"run_count": MOST_BEGINNINGS})
    assert not may_begin_again(tired)
