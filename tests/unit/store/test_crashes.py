"""Killed writers and collectors leave nothing half and remove nothing that counts."""

import os
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from store_comparison import compare_stores
from store_samples import (
    FRAMES,
    SMALL_CHUNK,
    SMALL_SHARD,
    place,
    publish,
    run_and_die,
    run_once,
    run_process,
    sample_arrays,
    sample_recipe,
)

from worldpose.errors import StoreError
from worldpose.store import groups
from worldpose.store.blobs import COMMIT_POINTS, install_fault_hook
from worldpose.store.garbage import collect, plan_gc
from worldpose.store.groups import array_parts
from worldpose.store.integrity import verify
from worldpose.store.paths import ResultId
from worldpose.store.runs import may_be_running
from worldpose.store.store import Store


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The project that an undisturbed run leaves."""
    with pytest.MonkeyPatch.context() as patch:
        # A module's fixture is made before a test's: the chunks must be the same small ones.
        patch.setattr("data_contracts.arrays.CHUNK_BYTES", SMALL_CHUNK)
        patch.setattr("data_contracts.arrays.SHARD_CHUNKS", SMALL_SHARD)
        store = Store.create(tmp_path_factory.mktemp("undisturbed"))
        run_once(store)
        yield store


def check_never_half(store):
    """All visible results are complete and correct."""
    assert verify(store) == ()
    for result in store.results():
        data = store.open_result(result.match_id, result.stage, result.unit, result.key)
        assert data.sizes["frame"] == FRAMES
        for name, values in sample_arrays().items():
            np.testing.assert_array_equal(data[name], values)
    for run_id in store.runs("final"):
        for name, key in store.run("final", run_id).results.items():
            assert store.has("final", *name.split("/"), key)


@pytest.mark.faults
@pytest.mark.parametrize("point", COMMIT_POINTS)
def test_killed_run_leaves_nothing_half_and_the_next_gives_the_same_answer(
    store, undisturbed, point
):
    process = run_process(run_and_die, store.url, point)
    process.join(60)
    assert process.exitcode == 9

    check_never_half(store)
    index = COMMIT_POINTS.index(point)
    assert store.has(*place()) == (index >= COMMIT_POINTS.index("after_commit"))
    assert bool(store.runs("final")) == (point == "after_run_record")
    unfinished = store.unfinished_runs("final")
    assert [run.run_id for run in unfinished if not may_be_running(run)] == (
        [] if point == "after_run_record" else ["0001"]
    )

    assert run_once(store) == "0002"
    check_never_half(store)
    assert compare_stores(store, undisturbed) == []
    assert store.manifest(*place()).run_id == (
        "0001" if index >= COMMIT_POINTS.index("after_commit") else "0002"
    )

    collect(store, plan_gc(store, older_than=timedelta(0)))
    assert store.blobs.staged_entries() == []
    assert store.unfinished_runs("final") == ()
    assert compare_stores(store, undisturbed) == []


def test_every_file_and_folder_is_on_disk_before_the_rename(folder_store, monkeypatch):
    synced: set[int] = set()
    synced_at_rename: set[int] = set()
    fsync, rename = os.fsync, Path.rename

    def record_fsync(descriptor):
        fsync(descriptor)
        synced.add(os.fstat(descriptor).st_ino)

    def record_rename(self, target):
        synced_at_rename.update(synced)
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", record_fsync)
    monkeypatch.setattr(Path, "rename", record_rename)
    publish(folder_store)
    top = Path(folder_store.url, ResultId(*place()).path)
    written = {path.stat().st_ino for path in (top, *top.rglob("*"))}
    assert len(written) > 10
    assert written <= synced_at_rename
    above = {path.stat().st_ino for path in list(top.parents)[:5]}
    assert above <= synced, "the names of the result and of the folders above it are on disk too"


@pytest.mark.parametrize("point", ["after_write", "during_publish", "before_commit"])
def test_interruption_by_hand_leaves_no_staging(folder_store, tmp_path, point):
    def interrupt(name):
        if name == point:
            raise KeyboardInterrupt

    install_fault_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_once(folder_store)
    install_fault_hook(None)
    check_never_half(folder_store)
    assert folder_store.blobs.staged_entries() == []
    assert [path for path in tmp_path.iterdir() if path.name.startswith("worldpose-")] == []


NOW = timedelta(0)


def test_what_no_run_reaches_is_listed_first_and_removed_second(store):
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
    assert (store.blobs.entries(leftover), verify(store)) == ([], ())


def test_match_with_a_run_at_work_is_left_alone(folder_store):
    store = folder_store
    publish(store)
    other = sample_recipe(match_id="semi")
    publish(store, other)
    run_id = store.reserve_run("final")
    plan = plan_gc(store, older_than=NOW)
    assert [item.path for item in plan.garbage] == [ResultId(*place(other)).path]
    assert f"forget final/{run_id}" in plan.held[0]
    plan = plan_gc(store, older_than=NOW, forget=[f"final/{run_id}"])
    assert (plan.held, len(plan.garbage)) == ((), 3)
    collect(store, plan)
    assert (store.results(), store.unfinished_runs("final")) == ((), ())


def test_result_of_which_something_was_removed_is_not_published(folder_store, monkeypatch):
    def removed(*given):
        for staged in folder_store.blobs.staged_entries():
            folder_store.blobs.delete_tree(staged.path, "manifest.json")
        return array_parts(*given)

    monkeypatch.setattr(groups, "array_parts", removed)
    with pytest.raises(StoreError, match="so nothing was published"):
        publish(folder_store)
    assert not folder_store.has(*place())
    assert folder_store.blobs.staged_entries() == []


@pytest.mark.parametrize("damaged", ["run", "manifest", "pin", "reservation"])
def test_a_match_with_a_damaged_record_is_left_alone_and_no_other(folder_store, damaged):
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


def test_interrupted_collection_is_finished_by_the_next(folder_store, monkeypatch):
    store = folder_store
    run_once(store, sample_recipe("one"), sample_recipe("two"))
    run_once(store, sample_recipe("three"))

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(type(store.blobs), "delete_tree", stop)
        with pytest.raises(KeyboardInterrupt):
            collect(store, plan_gc(store, older_than=NOW, keep_last=1))
    assert (verify(store), store.runs("final")) == ((), ("0002",))
    collect(store, plan_gc(store, older_than=NOW))
    assert {result.unit for result in store.results()} == {"three"}
