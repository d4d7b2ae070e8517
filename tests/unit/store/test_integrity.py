"""Every damage is found and named (F15)."""

from datetime import UTC, datetime, timedelta

import pytest
from store_samples import (
    place,
    publish,
    run_once,
    sample_recipe,
    sample_record,
    sample_registration,
)

from data_contracts.pin import Pin
from worldpose.errors import CorruptionError
from worldpose.store.documents import seal
from worldpose.store.garbage import plan_gc
from worldpose.store.integrity import repair, verify
from worldpose.store.paths import ResultId
from worldpose.store.runs import list_pins, pin_run

NOW = datetime(2026, 1, 1, tzinfo=UTC)


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
    assert repair(full, findings)[1] == (), "it is not ours to move"


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
    plan = plan_gc(full, older_than=timedelta(0))
    assert [each.path for each in plan.garbage if not each.path.startswith("staging")] == []
    assert full.reserve_run("final") == "0003"


def test_repair_sets_damaged_records_aside_and_readers_go_on(full):
    run_once(full)
    pin_run(
        full.blobs, Pin(name="v1", match_id="final", run_id="0001", who="A", why="", pinned_at=NOW)
    )
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
    assert repair(full, verify(full)) == ((ResultId(*place()),), ())
    assert not full.has(*place())
    assert full.has(*place(sample_recipe("late")))
    publish(full)
    assert verify(full) == ()
