from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from store_samples import run_once, sample_recipe

from data_contracts.pin import Pin
from worldpose.errors import InputError, StoreError
from worldpose.store import (
    Store,
    collect,
    list_pins,
    open_run,
    pin_run,
    plan_gc,
    unpin_run,
    verify,
)

NOW = timedelta(0)


def pin(name: str, run_id: str = "0001", why: str = "") -> Pin:
    return Pin(
        match_id="final", name=name, run_id=run_id, who="Ada", why=why, pinned_at=datetime.now(UTC)
    )


@pytest.fixture
def two_runs(folder_store: Store) -> Store:
    run_once(folder_store, sample_recipe("first"))
    run_once(folder_store, sample_recipe("second"))
    return folder_store


def test_a_pinned_run_and_its_results_outlast_all_others(two_runs: Store) -> None:
    pin_run(two_runs.blobs, pin("paper"))
    plan = plan_gc(two_runs, keep_last=1, older_than=NOW)
    assert plan.garbage == ()
    unpin_run(two_runs.blobs, "final", "paper")
    plan = plan_gc(two_runs, keep_last=1, older_than=NOW)
    assert {item.reason for item in plan.garbage} == {"run forgotten", "no kept run reaches it"}
    collect(two_runs, plan)
    assert two_runs.runs("final") == ("0002",)


def test_a_pinned_run_is_forgotten_only_after_its_name(two_runs: Store) -> None:
    pin_run(two_runs.blobs, pin("paper"))
    with pytest.raises(InputError, match="worldpose unpin final/paper"):
        plan_gc(two_runs, forget=["final/0001"])
    unpin_run(two_runs.blobs, "final", "paper")
    assert len(plan_gc(two_runs, forget=["final/0001"], older_than=NOW).garbage) == 2


def test_a_run_that_is_pinned_after_planning_is_not_removed(two_runs: Store) -> None:
    plan = plan_gc(two_runs, keep_last=1, older_than=NOW)
    pin_run(two_runs.blobs, pin("paper"))
    with pytest.raises(StoreError, match="plan again"):
        collect(two_runs, plan)
    assert two_runs.runs("final") == ("0001", "0002")


def test_a_name_is_as_good_as_a_number(two_runs: Store) -> None:
    pin_run(two_runs.blobs, pin("paper"))
    assert two_runs.run("final", "paper").run_id == "0001"
    assert open_run(two_runs.url, "final", "paper").record.run_id == "0001"
    with pytest.raises(InputError, match="no such run"):
        two_runs.run("final", "other")


def test_a_name_is_one_run_s_for_good(two_runs: Store) -> None:
    kept = pin_run(two_runs.blobs, pin("paper", why="first"))
    assert pin_run(two_runs.blobs, pin("paper", why="again")) == kept
    with pytest.raises(InputError, match="run 0001 under it"):
        pin_run(two_runs.blobs, pin("paper", run_id="0002"))
    pin_run(two_runs.blobs, pin("best", run_id="0001"))
    assert [each.name for each in list_pins(two_runs.blobs, "final")] == ["best", "paper"]
    with pytest.raises(InputError, match="best, paper"):
        unpin_run(two_runs.blobs, "final", "other")


@pytest.mark.parametrize("name", ["0002", "7", "latest"])
def test_a_name_cannot_be_taken_for_a_number(two_runs: Store, name: str) -> None:
    with pytest.raises(InputError, match="no run's number"):
        pin_run(two_runs.blobs, pin(name))


def test_a_changed_pin_is_found(two_runs: Store) -> None:
    pin_run(two_runs.blobs, pin("paper"))
    assert verify(two_runs) == ()
    path = "pins/final/paper.json"
    data = two_runs.blobs.read(path)
    assert data is not None
    two_runs.blobs.put(path, data.replace(b"0001", b"0002"))
    (finding,) = verify(two_runs)
    assert finding.path == path
    assert "checksum" in finding.problem
