"""Every damage is found and named; runs are numbered, locked, pinned and read."""

import json
import os
import shutil
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from store_samples import (
    PROCESSES,
    place,
    publish,
    run_once,
    run_process,
    sample_recipe,
    sample_record,
    sample_registration,
)

from data_contracts.pin import Pin
from worldpose.errors import CorruptionError, InputError, StoreError
from worldpose.store.blobs import LocalBlobs
from worldpose.store.documents import canonical_json, digest, seal
from worldpose.store.garbage import collect, plan_gc
from worldpose.store.integrity import repair, verify
from worldpose.store.paths import ResultId
from worldpose.store.runs import alone, hold_lock, list_pins, may_be_running, pin_run, unpin_run
from worldpose.store.store import Store, open_run

NOW = timedelta(0)


@pytest.fixture
def full(folder_store):
    """A project with every kind of file in it."""
    store = folder_store
    store.register(sample_registration())
    run_once(store, sample_recipe(), sample_recipe("late"))
    store.reserve_run("final")
    return store


def all_paths(store):
    tops = ("results", "runs", "matches")
    return ["project.json", *(entry.path for top in tops for entry in store.blobs.entries(top))]


def flip(store, path, number):
    """Flips one bit of a file and returns what it was."""
    data = store.blobs.read(path)
    flipped = bytearray(data)
    flipped[(number * 37) % len(data)] ^= 1 << (number % 8)
    store.blobs.put(path, bytes(flipped))
    return data


def is_document(path):
    return not path.startswith("results/") or path.endswith("/manifest.json")


def test_flipped_bits_in_all_data_are_found_in_one_go(full):
    damaged = [path for path in all_paths(full) if not is_document(path)]
    assert len(damaged) > 20
    for number, path in enumerate(damaged):
        flip(full, path, number)
    found = verify(full)
    assert [finding.path for finding in found] == sorted(damaged)
    assert all(finding.path in finding.problem for finding in found)


def test_flipped_bit_in_any_record_or_manifest_is_found_there(full):
    damaged = [path for path in all_paths(full) if is_document(path)]
    # The project, two manifests, a run, a reservation and a registration.
    assert len(damaged) == 6
    for number, path in enumerate(damaged):
        data = flip(full, path, number)
        assert [finding.path for finding in verify(full)] == [path]
        full.blobs.put(path, data)
    assert verify(full) == ()


def test_foreign_file_is_found(full):
    foreign = [
        f"{ResultId(*place()).path}/joints/c/9/0/0",
        "results/final/tracking/stray",
        "runs/final/notes.txt",
        "matches/.hidden.json",
        "runs/final/backup.json",
        "pins/final/._v1.json",
    ]
    for path in foreign:
        full.blobs.put(path, b"foreign")
    findings = verify(full)
    assert [finding.path for finding in findings] == sorted(foreign)
    assert all("remove it: it is not" in finding.problem for finding in findings)
    assert repair(full, findings) == ((), ()), "it is not ours to move, and damages no result"


def test_foreign_files_break_no_reader(full):
    """macOS and back-up programs put files of their own on shares."""
    names = (
        *("matches/.x.json", "matches/._final.json", "matches/a/b.json", "runs/.DS_Store"),
        *("runs/final/backup.json", "runs/final/.0001.json", "runs/final/0001.json.bak"),
        *("runs/.x/0001.json", "pins/final/._v1.json", "pins/final/.DS_Store", "pins/.DS_Store"),
        *("reviews/final/.DS_Store", "results/.DS_Store", "staging/.DS_Store"),
    )
    for path in names:
        full.blobs.put(path, b"{}")
    assert (full.matches(), full.runs("final")) == (("final",), ("0001",))
    assert full.run("final").run_id == "0001"
    assert [each.run_id for each in full.unfinished_runs("final")] == ["0002"]
    assert list_pins(full.blobs, "final") == ()
    plan = plan_gc(full, older_than=NOW)
    assert [each.path for each in plan.garbage if not each.path.startswith("staging")] == []
    assert full.reserve_run("final") == "0003"


@pytest.mark.parametrize("now", [None, True])
def test_repair_leaves_a_record_that_is_gone_or_whole_at_a_second_reading(full, now):
    record = "matches/final.json"
    whole = flip(full, record, 3)
    findings = verify(full)
    full.blobs.put(record, whole) if now else full.blobs.delete(record)
    assert (len(findings), repair(full, findings)) == (1, ((), ()))
    assert full.blobs.read(record) == (whole if now else None)
    assert not full.blobs.exists(f"{record}.damaged")


def test_repair_sets_damaged_records_aside_and_readers_go_on(full):
    run_once(full)
    pin_run(full.blobs, pin("v1"))
    damaged = ["matches/final.json", "pins/final/v1.json", "runs/final/0002.open.json"]
    damaged.append("runs/final/0003.json")
    for path in damaged:
        full.blobs.put(path, (full.blobs.read(path) or b"")[:40])
    for read in (full.run, full.registration, full.unfinished_runs):
        with pytest.raises(CorruptionError, match="verify --repair"):
            read("final")
    assert (repair(full, verify(full)), verify(full)) == (((), tuple(damaged)), ())
    assert (full.run("final").run_id, full.matches()) == ("0001", ())
    assert list_pins(full.blobs, "final") == ()
    assert len(full.blobs.read("runs/final/0003.json.damaged") or b"") == 40
    assert full.reserve_run("final") == "0004", "the number of a damaged run is not given again"


def test_whole_file_in_a_wrong_place_is_found(folder_store):
    full = folder_store
    full.blobs.put("runs/final/0007.json", seal(sample_record("0008")))
    full.blobs.put("matches/semi.json", seal(sample_registration("final")))
    assert [finding.path for finding in verify(full)] == [
        "matches/semi.json",
        "runs/final/0007.json",
    ]


def test_repair_withdraws_what_is_damaged_and_nothing_else(full):
    path = f"{ResultId(*place()).path}/joints/c/0/0/0"
    full.blobs.put(path, b"changed")
    findings = verify(full)
    assert "has changed" in findings[0].problem and "verify" not in findings[0].problem
    assert repair(full, findings) == ((ResultId(*place()),), ())
    assert "gc --forget final/0001" in verify(full)[0].problem  # other settings do not mend it
    assert not full.has(*place())
    assert full.has(*place(sample_recipe("late")))
    publish(full)
    assert verify(full) == ()


@pytest.mark.parametrize("what", ["EIO", "away", "version"])
def test_repair_keeps_results_that_it_cannot_read(full, monkeypatch, what):
    result, results = ResultId(*place()), full.results()
    read = LocalBlobs._read

    def fail(blobs, path, how):
        if what == "away":
            return None if path.startswith(f"{result.path}/joints") else read(blobs, path, how)
        raise StoreError(f"{path}: Input/output error")

    if what == "version":
        rewrite(full, result.manifest_path, lambda fields: fields.update(mood="good"))
    else:
        monkeypatch.setattr(LocalBlobs, "_read", fail)
    found = verify(full)
    assert any(result.path in finding.path for finding in found)
    monkeypatch.setattr(LocalBlobs, "_read", read)
    assert repair(full, found) == ((), ())
    assert full.results() == results


def test_unfinished_run_is_seen_and_is_not_the_latest(folder_store):
    store = folder_store
    run_once(store)
    assert store.reserve_run("final") == "0002"
    assert store.run("final").run_id == "0001"
    (unfinished,) = store.unfinished_runs("final")
    assert (unfinished.run_id, unfinished.pid) == ("0002", os.getpid())
    assert may_be_running(unfinished)
    with pytest.raises(InputError, match="an unfinished run"):
        store.run("final", "0002")


def reserve_some(url, outcome):
    store = Store.open(url)
    outcome.put([store.reserve_run("final") for _ in range(4)])


def hold_and_die(url, outcome):
    with alone(Store.open(url).blobs, "a", wait=False) as is_held:
        outcome.put(is_held)
        time.sleep(60.0)


def test_a_lock_excludes_other_processes_and_ends_with_its_process(folder_store):
    blobs, outcome = folder_store.blobs, PROCESSES.Queue()
    other = PROCESSES.Process(target=hold_and_die, args=(folder_store.url, outcome))
    other.start()
    assert outcome.get(timeout=60)
    with alone(blobs, "a", wait=False) as is_held, alone(blobs, "b", wait=False) as is_other:
        assert (is_held, is_other) == (False, True)
    other.kill()
    other.join()
    with alone(blobs, "a", wait=False) as is_held:
        assert is_held
    locks = Path(folder_store.url, "locks")
    shutil.rmtree(locks)
    locks.write_text("")  # as on a disk without locks
    with alone(blobs, "a", wait=False) as is_held, alone(blobs, "a", wait=False) as is_second:
        assert (is_held, is_second) == (True, False)


def test_a_wait_for_a_lock_ends_with_the_name_of_its_file(tmp_path):
    (tmp_path / "project.json").touch()
    file = tmp_path / "a.lock"
    with hold_lock(file, wait=True), pytest.raises(InputError, match=r"a\.lock: expected a lock"):
        hold_lock(file, wait=True, most_seconds=0.2).__enter__()


def test_processes_get_different_numbers(store):
    outcome = PROCESSES.Queue()
    processes = [run_process(reserve_some, store.url, outcome) for _ in range(3)]
    numbers = [number for _ in processes for number in outcome.get(timeout=60)]
    for process in processes:
        process.join(60)
    assert sorted(numbers) == [f"{number:04d}" for number in range(1, 13)]
    unfinished = store.unfinished_runs("final")
    assert [may_be_running(run) for run in unfinished] == [False] * 12


PLAN_NOW = timedelta(0)


def pin(name, run_id="0001", why=""):
    about = {"who": "Ada", "why": why, "pinned_at": datetime(2026, 1, 1, tzinfo=UTC)}
    return Pin(match_id="final", name=name, run_id=run_id, **about)


@pytest.fixture
def two_runs(folder_store):
    run_once(folder_store, sample_recipe("first"))
    run_once(folder_store, sample_recipe("second"))
    return folder_store


def test_a_pinned_run_and_its_results_outlast_all_others(two_runs):
    pin_run(two_runs.blobs, pin("paper"))
    plan = plan_gc(two_runs, keep_last=1, older_than=PLAN_NOW)
    assert plan.garbage == ()
    unpin_run(two_runs.blobs, "final", "paper")
    plan = plan_gc(two_runs, keep_last=1, older_than=PLAN_NOW)
    assert {item.reason for item in plan.garbage} == {"run forgotten", "no kept run reaches it"}
    collect(two_runs, plan)
    assert two_runs.runs("final") == ("0002",)


def test_the_newest_complete_run_outlasts_newer_ones_that_failed(two_runs):
    for _ in range(2):
        number = two_runs.reserve_run("final")
        two_runs.finish_run(sample_record(number, sample_recipe("first"), state="failed"))
    collect(two_runs, plan_gc(two_runs, keep_last=1, older_than=PLAN_NOW))
    assert two_runs.runs("final") == ("0002", "0004")
    assert two_runs.has(*place(sample_recipe("second")))
    plan = plan_gc(two_runs, keep_last=1, forget=["final/0002"], older_than=PLAN_NOW)
    assert plan.garbage[0].path == "runs/final/0002.json"


@pytest.mark.parametrize(
    ("iterations", "kept"),
    [([2, 1, 1], [3]), ([1, 2, 3, 2], [1, 3, 4]), ([1, 2, 1], [2, 3]), ([1, 1, 2, 3], [2, 3, 4])],
)
def test_the_iterations_of_the_last_call_outlast_those_before(folder_store, iterations, kept):
    for iteration in iterations:
        number = folder_store.reserve_run("final")
        folder_store.finish_run(sample_record(number, iteration=iteration))
    collect(folder_store, plan_gc(folder_store, keep_last=1, older_than=PLAN_NOW))
    assert folder_store.runs("final") == tuple(f"{number:04}" for number in kept)


@pytest.mark.parametrize("state", ["complete", "partial"])
def test_the_newest_run_with_bodies_outlasts_newer_parts_of_the_method(two_runs, state):
    tracked, fitted = sample_recipe("third"), sample_recipe(stage="body_fitting")
    whole = two_runs.reserve_run("final")
    publish(two_runs, fitted, run_id=whole)
    two_runs.finish_run(sample_record(whole, sample_recipe("first"), fitted, state=state))
    parts = [run_once(two_runs, tracked) for _ in range(2)]
    collect(two_runs, plan_gc(two_runs, keep_last=1, older_than=PLAN_NOW))
    assert two_runs.runs("final") == (whole, parts[-1])
    assert two_runs.has(*place(sample_recipe("first")))
    assert not two_runs.has(*place(sample_recipe("second")))


@pytest.mark.parametrize("number", ["0002", "0004"])
@pytest.mark.parametrize("is_damaged", [True, False])
def test_an_unreadable_record_is_not_complete_and_does_not_end_the_planning(
    two_runs, number, is_damaged
):
    for _ in range(2):
        failed = two_runs.reserve_run("final")
        two_runs.finish_run(sample_record(failed, sample_recipe("first"), state="failed"))
    record = f"runs/final/{number}.json"
    if is_damaged:
        flip(two_runs, record, 3)
    else:
        rewrite(two_runs, record, lambda fields: fields.update(mood="good"))
    plan = plan_gc(two_runs, keep_last=1, older_than=PLAN_NOW)
    if number == "0004":  # it is kept, and what it reaches is unknown
        assert (plan.garbage, len(plan.held), record in plan.held[0]) == ((), 1, True)
    else:
        collect(two_runs, plan)
        assert (plan.held, two_runs.runs("final")) == ((), ("0001", "0004"))


def test_a_run_that_is_pinned_after_planning_is_not_removed(two_runs):
    plan = plan_gc(two_runs, keep_last=1, older_than=PLAN_NOW)
    pin_run(two_runs.blobs, pin("paper"))
    with pytest.raises(StoreError, match="Make a new plan"):
        collect(two_runs, plan)
    assert two_runs.runs("final") == ("0001", "0002")


def test_a_name_is_as_good_as_a_number_and_one_run_s_for_good(two_runs):
    kept = pin_run(two_runs.blobs, pin("paper", why="first"))
    assert two_runs.run("final", "paper").run_id == "0001"
    assert open_run(two_runs.url, "final", "paper").record.run_id == "0001"
    with pytest.raises(InputError, match="no such run"):
        two_runs.run("final", "other")
    assert pin_run(two_runs.blobs, pin("paper", why="again")) == kept
    with pytest.raises(InputError, match="run 0001 pinned under"):
        pin_run(two_runs.blobs, pin("paper", run_id="0002"))
    pin_run(two_runs.blobs, pin("best"))
    assert [each.name for each in list_pins(two_runs.blobs, "final")] == ["best", "paper"]
    with pytest.raises(InputError, match="best, paper"):
        unpin_run(two_runs.blobs, "final", "other")


def rewrite(store, path, change):
    """A document as another version would have sealed it."""
    fields = json.loads(store.blobs.read(path) or b"")
    del fields["checksum"]
    change(fields)
    sealed = {**fields, "checksum": digest(canonical_json(fields))}
    store.blobs.put(path, canonical_json(sealed) + b"\n")


def test_a_store_of_another_format_is_refused_before_anything_is_read(folder_store):
    run_once(folder_store)
    rewrite(folder_store, "project.json", lambda fields: fields.update(store_format="0"))
    with pytest.raises(InputError, match=r"store_format.*expected '3', found '0'") as refused:
        Store.open(folder_store.url)
    assert "Use the version of worldpose that made the project" in str(refused.value)
    with pytest.raises(InputError, match="store_format"):
        Store.create(folder_store.url)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda fields: fields.update(mood="good"), "the unknown field mood"),
        (lambda fields: fields.pop("usability"), "no field usability"),
    ],
)
def test_a_run_that_another_version_recorded_is_refused_as_such(folder_store, change, found):
    run_once(folder_store)
    rewrite(folder_store, "runs/final/0001.json", change)
    with pytest.raises(InputError, match=f"found {found}: another version") as refused:
        folder_store.run("final")
    assert "worldpose run FOLDER --project NEW" in str(refused.value)
    # It is not damaged, but it is said.
    (finding,) = verify(folder_store)
    assert "another version" in finding.problem
