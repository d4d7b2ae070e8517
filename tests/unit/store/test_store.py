"""Results are published whole and once, even by writers and collectors that are killed."""

import errno
import os
import pickle
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from store_comparison import compare_stores
from store_samples import (
    ATTRIBUTES,
    FRAMES,
    LAYOUT,
    PROCESSES,
    SMALL_CHUNK,
    SMALL_SHARD,
    all_sample_arrays,
    place,
    publish,
    run_and_die,
    run_once,
    run_process,
    sample_arrays,
    sample_coordinates,
    sample_recipe,
    sample_work,
)

import worldpose
from worldpose.errors import (
    CorruptionError,
    InputError,
    InternalError,
    NondeterminismError,
    StoreError,
)
from worldpose.store import groups
from worldpose.store.blobs import COMMIT_POINTS, install_fault_hook
from worldpose.store.garbage import collect, plan_gc
from worldpose.store.groups import array_parts
from worldpose.store.integrity import verify
from worldpose.store.paths import ResultId
from worldpose.store.runs import may_be_running
from worldpose.store.store import Store


def test_result_comes_back_with_labels_units_and_conventions(store):
    with store.publish(sample_work(store)) as writer:
        writer.write(LAYOUT, all_sample_arrays(), sample_coordinates(), ATTRIBUTES)
        writer.figures["mean_views"] = 2.5
    manifest = writer.manifest
    data = store.open_result(*place(), verify=True)
    for name, values in all_sample_arrays().items():
        np.testing.assert_array_equal(data[name].values, values)
        assert data[name].dtype == values.dtype
    assert data.joints.dims == ("frame", "person", "coordinate")
    assert list(data.coordinate.values) == ["x", "y", "z"]
    assert list(data.camera.values) == ["left", "right"]
    assert data.frame.values[0] == 100
    assert data.joints.sel(frame=103, person=1, coordinate="x").isnull()
    assert data.joints.attrs["units"] == "m"
    assert data.joints.attrs["missing"] == "nan"
    assert "centre spot" in data.attrs["conventions"]["world"]
    assert data.attrs["detector"] == "none"
    assert (data.attrs["match"], data.attrs["stage"], data.attrs["unit"]) == place()[:3]
    assert manifest.figures == {"mean_views": 2.5}
    assert manifest == store.manifest(*place())


def test_unknown_projects_and_results_are_errors_that_say_what_to_run(url):
    with pytest.raises(InputError, match=r"no worldpose project at .*worldpose init"):
        Store.open(url)
    store = Store.create(url)
    assert not store.has(*place())
    with pytest.raises(StoreError, match="worldpose run final"):
        store.open_result(*place())


def test_absent_bucket_is_a_store_error_that_names_it(bucket):
    with pytest.raises(StoreError, match=r"s3://nowhere/project\.json.*AWS_ENDPOINT_URL"):
        Store.create("s3://nowhere")
    for make, address, told in (
        (Store.create, "s3://", "no bucket"),
        (Store.open, "gs://e/p", "'gs'"),
    ):
        with pytest.raises(InputError, match=told):
            make(address)


def test_manifest_of_another_result_is_corruption(folder_store):
    publish(folder_store)
    other = sample_recipe("other")
    data = folder_store.blobs.read(ResultId(*place()).manifest_path)
    folder_store.blobs.put(ResultId(*place(other)).manifest_path, data)
    with pytest.raises(CorruptionError, match="of another result"):
        folder_store.manifest(*place(other))


def publish_together(url, barrier, outcome):
    store = Store.open(url)
    barrier.wait(30)
    writer = publish(store, run_id=f"{os.getpid()}")
    outcome.put(writer.manifest.content)


def test_many_writers_of_one_key_make_one_result(store):
    barrier, outcome = PROCESSES.Barrier(4), PROCESSES.Queue()
    writers = [run_process(publish_together, store.url, barrier, outcome) for _ in range(4)]
    contents = {outcome.get(timeout=60) for _ in writers}
    for writer in writers:
        writer.join(60)
        assert writer.exitcode == 0
    assert contents == {store.manifest(*place()).content}
    assert (verify(store), store.blobs.staged_entries()) == ((), [])


@pytest.mark.parametrize(
    ("failing", "code"),
    [
        ("os.fsync", errno.ENOSPC),
        ("pathlib.Path.rename", errno.EACCES),
        ("pathlib.Path.mkdir", errno.EROFS),
        ("pathlib.Path.read_bytes", errno.EIO),
        ("pathlib.Path.open", errno.ENOSPC),
    ],
)
def test_failing_disk_is_a_store_error_and_a_retry_succeeds(tmp_path, monkeypatch, failing, code):
    store = Store.create(tmp_path / "project")
    publish(store, sample_recipe("earlier"))

    def fail(*_, **__):
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(failing, fail)
        with pytest.raises(StoreError, match=os.strerror(code)) as caught:
            publish(store)
    assert str(tmp_path / "project") in str(caught.value)
    assert "Published results are unchanged" in str(caught.value)
    assert not store.has(*place())
    assert (verify(store), store.blobs.staged_entries()) == ((), [])
    publish(store)
    assert verify(store) == ()


def test_run_gives_its_results_by_unit(store):
    run_once(store, sample_recipe("late"), sample_recipe())
    run = worldpose.open_run(store.url, "final")
    assert (list(run), len(run)) == (["tracking/clip", "tracking/late"], 2)
    assert run.record.run_id == "0001"
    assert "tracking/clip" in run
    np.testing.assert_array_equal(run["tracking/clip"].joints, sample_arrays()["joints"])
    assert run["tracking/clip"] is run["tracking/clip"]
    assert "Run 0001 of match final: complete" in repr(run)
    assert "tracking/late" in repr(run)


def write_sample(writer, times=1, **figures):
    for _ in range(times):
        writer.write(LAYOUT, sample_arrays(), sample_coordinates(), ATTRIBUTES)
    writer.figures.update(figures)


@pytest.mark.parametrize(
    ("change", "write", "error", "told"),
    [
        ({}, lambda _: None, StoreError, "the stage wrote no arrays"),
        ({}, lambda w: write_sample(w, 2), StoreError, "written only once"),
        ({}, lambda w: write_sample(w, error_px=np.nan), InternalError, "metric error_px"),
        ({"recipe": sample_recipe("other")}, write_sample, InputError, "of its recipe"),
    ],
)
def test_work_that_breaks_the_rules_is_not_published(folder_store, change, write, error, told):
    work = sample_work(folder_store).model_copy(update=change)
    with pytest.raises(error, match=told), folder_store.publish(work) as writer:
        write(writer)
    assert folder_store.results() == ()


def test_a_key_is_computed_once_and_other_bytes_are_an_error(store, tmp_path):
    twin = Store.create(tmp_path / "twin")
    first = publish(store, run_id="0001").manifest
    assert publish(store, run_id="0002").manifest == first
    assert publish(twin).manifest.content == first.content
    # 40 frames of 72 bytes in chunks of at least 512 bytes: 8 frames each, two chunks in a file;
    # views are all zero, and written nevertheless.
    files = [file.path for file in first.files]
    assert [name for name in files if name.startswith("joints/c/")] == [
        f"joints/c/{number}/0/0" for number in range(3)
    ]
    assert "views/c/0" in files
    with pytest.raises(NondeterminismError, match="detection_index/c/0/0"):
        publish(store, seed=1)
    assert store.manifest(*place()) == first
    assert verify(store) == ()
    np.testing.assert_array_equal(store.open_result(*place()).joints, sample_arrays(0)["joints"])
    assert Store.create(store.url).has(*place())
    assert pickle.loads(pickle.dumps(store)).has(*place())


def test_lost_or_changed_chunk_is_corruption_and_never_a_fill_value(store):
    publish(store)
    path = f"{ResultId(*place()).path}/joints/c/1/0/0"
    data = store.blobs.read(path)
    # Frames 16 to 23 and 24 to 31, then the index of places and sizes with its CRC-32C.
    (_, second), (start, _) = np.frombuffer(data[-36:-4], "<u8").reshape(2, 2).tolist()
    assert start == second
    changed = data[:start] + bytes([data[start] ^ 1]) + data[start + 1 :]
    cut = data[: start + 5] + data[-36:]
    for now in (changed, data[:-1], data[:start], cut, b"", None):
        store.blobs.delete(path) if now is None else store.blobs.put(path, now)
        told = "the file is missing" if now is None else ""
        for verified in (False, True):
            with pytest.raises(CorruptionError, match=f"{path} has changed since its pub.*{told}"):
                store.open_result(*place(), verify=verified).joints[24:32].load()
        np.testing.assert_array_equal(
            store.open_result(*place()).joints[:10], sample_arrays()["joints"][:10]
        )
    store.blobs.put(path, changed)
    np.testing.assert_array_equal(
        store.open_result(*place()).joints[16:24], sample_arrays()["joints"][16:24]
    )


BAD = ["", "/", "/etc/passwd", "..", "a/../b", "a/..", "./a", "a//b", "a/", "a\0b", "a\nb", "a\\b"]


def test_path_that_could_leave_the_project_is_refused_by_every_method(store, tmp_path):
    before, blobs = sorted(tmp_path.rglob("*")), store.blobs
    one = (blobs.read, blobs.exists, blobs.delete, blobs.entries)
    for path in BAD:
        for call, *more in (
            *((method,) for method in one),
            *((method, b"x") for method in (blobs.put, blobs.put_new)),
            (blobs.delete_tree, "manifest.json"),
        ):
            with pytest.raises(InputError, match="path inside a project"):
                call(path, *more)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("key", ["", "0" * 31, "0" * 33, "G" * 32, "A" * 32, "../" + "0" * 29])
def test_key_that_is_no_key_is_refused(key):
    with pytest.raises(InputError, match="32 lower-case"):
        ResultId("final", "tracking", "clip", key)


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
