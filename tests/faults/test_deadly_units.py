"""A unit that hangs or ends its process each time is given up; the rest finishes."""

from pathlib import Path

import pytest
from command_line import TINY, worldpose

from worldpose.store.store import Store

pytestmark = [pytest.mark.usefixtures("server"), pytest.mark.faults, pytest.mark.slow]

UNIT = "ingest/cam01"


@pytest.mark.parametrize(
    ("how", "error", "said"),
    [
        # A worker's first unit took 5 s on two busy cores.
        ("hang", "TaskTimeoutError", "stopped 2 times, each time after 0.5 minutes"),
        ("die", "WorkerCrashError", "its process ended 3 times"),
    ],
)
def test_a_deadly_unit_is_given_up_and_named_and_the_others_finish(
    how, error, said, tiny, tmp_path
):
    spoil = {
        "WORLDPOSE_TEST_SPOIL": f"{how} {UNIT}",
        "DASK_DISTRIBUTED__WORKER__PRELOAD": str(Path(__file__).with_name("spoil.py")),
    }
    project = tmp_path / "worldpose-data"
    limited = ("--until", "ingest", "--time-limit", 0.5)
    answer = worldpose("run", tiny, "--project", project, *limited, environment=spoil)
    assert answer.code == 4, answer.err
    record = Store.open(str(project)).run(TINY)
    (failure,) = record.failed
    assert (record.state, failure.unit, failure.error) == ("partial", UNIT, error)
    assert said in failure.message
    if how == "hang":
        assert "spoil.py" in failure.message, "it is not said where it hung"
    assert len(record.executed) == len(record.results) == 6
    again = worldpose("run", tiny, "--project", project, "--until", "ingest", "--json")
    assert (again.code, again.json["executed"]) == (0, 1)
