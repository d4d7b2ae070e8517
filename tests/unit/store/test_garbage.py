from __future__ import annotations

from datetime import timedelta
from typing import Any

import pytest
from store_samples import place, publish, run_once, sample_recipe

from worldpose.errors import StoreError
from worldpose.store import groups
from worldpose.store.garbage import collect, plan_gc
from worldpose.store.groups import array_parts
from worldpose.store.integrity import verify
from worldpose.store.paths import ResultId
from worldpose.store.store import Store

NOW = timedelta(0)


def test_what_no_run_reaches_is_listed_first_and_removed_second(store: Store) -> None:
    run_once(store)
    publish(store, sample_recipe("unused"))
    leftover = ResultId(*place(sample_recipe("dead"))).path
    store.blobs.put(f"{leftover}/joints/c/0", b"half")
    plan = plan_gc(store, older_than=NOW)
    assert {item.path: item.reason for item in plan.garbage} == {
        ResultId(*place(sample_recipe("unused"))).path: "no kept run reaches it",
        leftover: "never published",
    }
    assert store.has(*place(sample_recipe("unused"))), "planning removes nothing"
    assert collect(store, plan) == plan.size > 4
    assert store.results() == (ResultId(*place()),)
    assert store.blobs.entries(leftover) == []
    assert verify(store) == ()


def test_match_with_a_run_at_work_is_left_alone(folder_store: Store) -> None:
    store = folder_store
    publish(store)
    other = sample_recipe(match_id="semi")
    publish(store, other)
    run_id = store.reserve_run("final")
    plan = plan_gc(store, older_than=NOW)
    assert [item.path for item in plan.garbage] == [ResultId(*place(other)).path]
    assert f"forget final/{run_id}" in plan.held[0]
    plan = plan_gc(store, older_than=NOW, forget=[f"final/{run_id}"])
    assert plan.held == ()
    assert len(plan.garbage) == 3
    collect(store, plan)
    assert store.results() == ()
    assert store.unfinished_runs("final") == ()


def test_result_of_which_something_was_removed_is_not_published(
    folder_store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def removed(*given: Any) -> Any:
        for staged in folder_store.blobs.staged_entries():
            folder_store.blobs.delete_tree(staged.path, "manifest.json")
        return array_parts(*given)

    monkeypatch.setattr(groups, "array_parts", removed)
    with pytest.raises(StoreError, match="so nothing was published"):
        publish(folder_store)
    assert not folder_store.has(*place())
    assert folder_store.blobs.staged_entries() == []


@pytest.mark.parametrize("damaged", ["run", "manifest", "pin", "reservation"])
def test_a_match_with_a_damaged_record_is_left_alone_and_no_other(
    folder_store: Store, damaged: str
) -> None:
    run_once(folder_store)
    publish(folder_store, sample_recipe("spare"))
    publish(folder_store, sample_recipe(match_id="semi"))
    path = {
        "run": "runs/final/0001.json",
        "manifest": ResultId(*place()).manifest_path,
        "pin": "pins/final/v1.json",
        "reservation": "runs/final/0002.open.json",
    }[damaged]
    folder_store.blobs.put(path, b"damaged")
    plan = plan_gc(folder_store, older_than=NOW)
    assert {garbage.path.split("/")[1] for garbage in plan.garbage} == {"semi"}
    (reason,) = plan.held
    assert reason.startswith("Match final is skipped: ")
    assert path in reason
    collect(folder_store, plan)
    assert folder_store.has(*place(sample_recipe("spare")))


def test_interrupted_collection_is_finished_by_the_next(
    folder_store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = folder_store
    run_once(store, sample_recipe("one"), sample_recipe("two"))
    run_once(store, sample_recipe("three"))

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(store.blobs), "delete_tree", stop)
        with pytest.raises(KeyboardInterrupt):
            collect(store, plan_gc(store, older_than=NOW, keep_last=1))
    assert verify(store) == ()
    assert store.runs("final") == ("0002",)
    collect(store, plan_gc(store, older_than=NOW))
    assert {result.unit for result in store.results()} == {"three"}
