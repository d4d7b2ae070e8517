"""Runs that restart automatically."""

import pytest

from flows.service.recovery import DEATHS, MOST_BEGINNINGS, MOST_SERVICE_DEATHS, may_restart

LOST = "Flow run encountered an exception: LostWorkersError: the Dask scheduler was lost"
KILLED = "its process was killed"


def ended(kind, message=KILLED, count=1, labels=None):
    state = {"type": kind, "message": message}
    return {"state": state, "state_type": kind, "run_count": count, "labels": labels}


@pytest.mark.parametrize(
    ("run", "again"),
    [
        (ended("CRASHED"), True),
        (ended("FAILED", LOST), True),
        (ended("FAILED", "Flow run encountered an exception: IncompleteRunError"), False),
        (ended("COMPLETED"), False),
        (ended("CRASHED", count=MOST_BEGINNINGS), False),
        # A start that ended with the whole service does not count.
        (ended("CRASHED", count=MOST_BEGINNINGS, labels={DEATHS: 1}), True),
        (ended("CRASHED", count=MOST_BEGINNINGS + 1, labels={DEATHS: 1}), False),
        (ended("CRASHED", count=MOST_BEGINNINGS + MOST_SERVICE_DEATHS, labels={DEATHS: 99}), False),
    ],
)
def test_runs_begin_again_that_ended_by_no_fault_of_their_own(run, again):
    assert may_restart(run) is again
