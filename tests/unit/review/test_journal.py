"""The journal keeps entries whole and in order, whatever is killed, truncated or concurrent."""

import uuid
from datetime import UTC, datetime
from multiprocessing import get_context

import pytest
import run_records
from run_records import review_request

from data_contracts.review import MovedPoint, ReviewDecision
from worldpose.errors import CorruptionError, StoreError
from worldpose.review.journal import append, last_decision, read_journal, requests_by_id, say
from worldpose.store.integrity import verify
from worldpose.store.store import Store

NOW = datetime(2026, 1, 2, tzinfo=UTC)


def correction(name, x=1.0):
    edit = MovedPoint(camera="cam00", marking="corner_left_near", was=(0.0, 0.0), xy=(x, 2.0))
    return run_records.correction(edit, name)


def request(name, content):
    about = {"reasons": ("undecided is 1, at most 0 passes",), "figures": {"undecided": 1.0}}
    unit = "tracking/clip"
    return review_request(name, keys={unit: "0" * 32}, contents={unit: content}, **about)


def decision(name, verdict):
    return ReviewDecision(match_id="m", request=name, verdict=verdict, who="Ada", decided_at=NOW)


@pytest.fixture
def store(tmp_path):
    return Store.create(tmp_path / "project")


def files(store):
    return [store.blobs.root / entry.path for entry in store.blobs.entries("reviews/m")]


def said(journal):
    return [record.id for record in journal.records]


def test_what_was_said_at_once_is_read_back_in_order(store):
    for names in (["a"], ["b", "c"], ["d"]):
        say(store, "m", lambda _, names=names: [correction(name) for name in names])
    journal = read_journal(store, "m")
    assert said(journal) == ["a", "b", "c", "d"]
    assert [entry.number for entry in journal.entries] == [1, 2, 3]
    assert journal.entries[0].previous is None
    assert len({entry.previous for entry in journal.entries}) == 3
    assert verify(store) == ()


def test_a_last_entry_cut_short_at_any_byte_is_told_and_ignored(store):
    say(store, "m", lambda _: [correction("a")])
    say(store, "m", lambda _: [correction("b"), correction("c")])
    last = files(store)[-1]
    whole = last.read_bytes()
    changed = whole.replace(b"Ada", b"Eve", 1)
    for size, data in [*((n, whole[:n]) for n in range(0, len(whole), 7)), ("changed", changed)]:
        last.write_bytes(data)
        journal = read_journal(store, "m")
        assert said(journal) == ["a"], size
        (told,) = journal.damage
        assert str(last) in told
        assert "must be said again" in told
    last.write_bytes(whole)
    assert said(read_journal(store, "m")) == ["a", "b", "c"]


@pytest.mark.parametrize("harm", ["cut", "gone"])
def test_an_entry_that_later_ones_build_on_is_missed(store, harm):
    for name in "abc":
        say(store, "m", lambda _, name=name: [correction(name)])
    assert said(read_journal(store, "m")) == ["a", "b", "c"]
    second = files(store)[1]
    if harm == "cut":
        second.write_bytes(second.read_bytes()[:-10])
    else:
        second.unlink()
    with pytest.raises(CorruptionError, match="000003"):
        read_journal(Store.open(store.url), "m")  # another process, which has read nothing yet
    assert said(read_journal(store, "m")) == ["a", "b", "c"], "this one has"
    assert "000003" in verify(store)[-1].path


def test_many_processes_at_once_lose_and_double_nothing(store):
    context = get_context("fork")
    writers = [context.Process(target=say_ten, args=(store.url, writer)) for writer in range(3)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join(120)
    found = said(read_journal(store, "m"))
    assert sorted(found) == sorted(f"{writer}.{n}" for writer in range(3) for n in range(10))
    assert verify(store) == ()


def say_ten(url, writer):
    store = Store.open(url)
    for number in range(10):
        say(store, "m", lambda _, number=number: [correction(f"{writer}.{number}")])


def test_the_journal_is_the_same_in_object_storage(bucket):
    store = Store.create(f"{bucket}/{uuid.uuid4().hex}")
    say(store, "m", lambda _: [correction("a")])
    stale = read_journal(store, "m")
    say(store, "m", lambda _: [correction("b"), correction("c")])
    assert append(store, stale, [correction("d")]) is None
    assert said(read_journal(store, "m")) == ["a", "b", "c"]
    last = store.blobs.entries("reviews/m")[-1].path
    store.blobs.put(last, store.blobs.read(last)[:-10])
    journal = read_journal(store, "m")
    assert said(journal) == ["a"]
    assert last in journal.damage[0]
    assert [finding.path for finding in verify(store)] == [last]


def test_the_last_verdict_on_the_same_bytes_counts(store):
    one, other = "1" * 64, "2" * 64
    say(store, "m", lambda _: [request("q1", one)])
    say(store, "m", lambda _: [decision("q1", "reject")])
    records = tuple(read_journal(store, "m").records)
    assert last_decision(records, "tracking/clip", one).verdict == "reject"
    assert last_decision(records, "tracking/clip", other) is None
    assert last_decision(records, "tracking/other", one) is None
    # The same bytes under another key are another question, and the later verdict is the one.
    say(store, "m", lambda _: [request("q2", one), decision("q2", "approve")])
    records = tuple(read_journal(store, "m").records)
    assert last_decision(records, "tracking/clip", one).verdict == "approve"
    assert list(requests_by_id(records)) == ["q1", "q2"]


def test_a_full_disk_is_told_and_leaves_the_journal_as_it_was(store, monkeypatch):
    say(store, "m", lambda _: [correction("a")])

    def fail(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("worldpose.store.blobs.os.fsync", fail)
        with pytest.raises(StoreError, match="No space left"):
            say(store, "m", lambda _: [correction("b")])
    assert said(read_journal(store, "m")) == ["a"]
