"""Append-only journal of a match: review requests, decisions and corrections.

Each entry is one sealed file, `reviews/<match>/<number>.json`, created atomically and durably, on a
disk and in object storage alike; creation fails if another writer took the number, so that no entry
is lost. Each entry contains the checksum of its predecessor, so that a lost or changed entry is
detectable.

A process caches the journal: each later call reads only the last known entry and newer ones.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

from data_contracts.review import (
    Correction,
    JournalEntry,
    ReviewDecision,
    ReviewRecord,
    ReviewRequest,
    Withdrawal,
)
from worldpose.errors import CorruptionError
from worldpose.store.documents import read_checksum, record_checksum, seal, unseal
from worldpose.store.paths import checked_name
from worldpose.store.store import Store

_ENTRY = re.compile(r"(\d{6,})\.json")
MOST_KEPT = 50
"""Journals that a process keeps, those read last."""


@dataclass(frozen=True)
class Journal:
    """Content of a match's journal.

    Attributes:
        match_id: the match.
        entries: the intact entries, first to last.
        last: the highest number in use, by an intact or a damaged entry.
        damage: a line for each damaged entry, which is ignored and must be repeated.
        tip: checksum of the last intact entry, the predecessor of the next one.
        questions: the requests and decisions among the records, in order.
        corrections: correction by id, including withdrawn ones.
        standing: correction by id, in the order they were made, without withdrawn ones.
    """

    match_id: str
    entries: tuple[JournalEntry, ...] = ()
    last: int = 0
    damage: tuple[str, ...] = ()
    tip: str | None = None
    questions: tuple[ReviewRequest | ReviewDecision, ...] = ()
    corrections: Mapping[str, Correction] = field(default_factory=dict)
    standing: Mapping[str, Correction] = field(default_factory=dict)

    @property
    def records(self) -> Iterator[ReviewRecord]:
        """All records, in order."""
        for entry in self.entries:
            yield from entry.records

    def extend(
        self, entries: Sequence[JournalEntry], last: int, damage: Sequence[str], tip: str | None
    ) -> Journal:
        """Return the journal with further intact entries and lines about damaged ones.

        Earlier entries are not processed again.
        """
        questions = list(self.questions)
        corrections, standing = dict(self.corrections), dict(self.standing)
        for entry in entries:
            for record in entry.records:
                if isinstance(record, ReviewRequest | ReviewDecision):
                    questions.append(record)
                elif isinstance(record, Correction):
                    corrections[record.id] = standing[record.id] = record
                elif isinstance(record, Withdrawal):
                    standing.pop(record.correction, None)
        return Journal(
            self.match_id,
            (*self.entries, *entries),
            last,
            (*self.damage, *damage),
            tip,
            tuple(questions),
            corrections,
            standing,
        )


def read_journal(store: Store, match_id: str) -> Journal:
    """Return a match's journal, empty before its first entry.

    A damaged entry without a successor was never acknowledged, or its disk lost it: the function
    ignores it and lists it in `damage`.

    The function caches per store object: if the last entry is unchanged, it reads only newer ones.
    Only `verify` and the next process detect later damage to earlier entries. CorruptionError if an
    entry with a successor is damaged or missing, InputError if one has another contract version.
    """
    folder = f"reviews/{checked_name(match_id)}"
    with _KNOWN_LOCK:
        kept = _KNOWN.setdefault(store, {})
        known = kept[match_id] = kept.pop(match_id, _Known())
        while len(kept) > MOST_KEPT:
            del kept[next(iter(kept))]
    with known.lock:  # concurrent requests read a long journal only once
        journal = known.journal or Journal(match_id)
        there = journal.last and store.blobs.read(_path(match_id, journal.last))
        if not journal.last or there != known.last_data:
            journal, known.last_data = Journal(match_id), None
            names = (entry.path.rpartition("/")[2] for entry in store.blobs.entries(folder))
            numbers = sorted(int(found[1]) for found in map(_ENTRY.fullmatch, names) if found)
        else:
            numbers = []
        found = _contents(store, match_id, numbers)
        while (data := store.blobs.read(_path(match_id, _last(journal, found) + 1))) is not None:
            found.append((_last(journal, found) + 1, data))
        journal = _extend(journal, found, f"{store.url}/{folder}")
        known.last_data = found[-1][1] if found else known.last_data
        known.journal = journal
        return journal


@dataclass
class _Known:
    """Cached journal of a store object, None before the first read, with its last entry's bytes.

    The reading thread holds the lock.
    """

    journal: Journal | None = None
    last_data: bytes | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


_KNOWN: WeakKeyDictionary[Store, dict[str, _Known]] = WeakKeyDictionary()
_KNOWN_LOCK = threading.Lock()


def _contents(store: Store, match_id: str, numbers: Sequence[int]) -> list[tuple[int, bytes]]:
    """Return the numbers and bytes of listed entries; no bytes for an entry that disappeared."""

    def read(some: Sequence[int]) -> list[tuple[int, bytes]]:
        return [(number, store.blobs.read(_path(match_id, number)) or b"") for number in some]

    batch_size = 64  # entries that one reader fetches in a row
    batches = [numbers[first : first + batch_size] for first in range(0, len(numbers), batch_size)]
    reader_count = 8  # in object storage each entry is a separate request
    with ThreadPoolExecutor(reader_count) as pool:
        return [each for some in pool.map(read, batches) for each in some]


def _last(journal: Journal, found: Sequence[tuple[int, bytes]]) -> int:
    return found[-1][0] if found else journal.last


def _extend(journal: Journal, found: Sequence[tuple[int, bytes]], folder: str) -> Journal:
    """Return the journal with further entries, given as numbers and bytes."""
    if not found:
        return journal
    entries: list[JournalEntry] = []
    damage: list[str] = []
    tip = journal.tip
    for number, data in found:
        where = f"{folder}/{number:06d}.json"
        try:
            entry = unseal(JournalEntry, data, where)
        except CorruptionError as error:
            damage.append(f"{error}; it is ignored: what it said must be said again")
            continue
        if (entry.match_id, entry.number) != (journal.match_id, number):
            raise CorruptionError(f"{where} is entry {entry.number} of {entry.match_id}")
        if entry.previous != tip:
            before = [*journal.entries[-1:], *entries[-1:]]
            whole = f"entries up to {before[-1].number}" if before else "no entries"
            raise CorruptionError(
                f"{where} builds on an entry that is missing or damaged; {whole} before it are "
                f"intact. Restore the folder {folder} from a copy."
            )
        entries.append(entry)
        tip = read_checksum(data)
    return journal.extend(entries, found[-1][0], damage, tip)


def append(store: Store, journal: Journal, records: Sequence[ReviewRecord]) -> Journal | None:
    """Return the journal as read with one more entry of all records, which is durable on return.

    None if another writer added an entry since: nothing is written; read and decide again.
    StoreError if the store cannot write the entry; nothing is written.
    """
    number = journal.last + 1
    entry = JournalEntry(
        match_id=journal.match_id, number=number, previous=journal.tip, records=tuple(records)
    )
    if not store.blobs.put_new(_path(journal.match_id, number), seal(entry)):
        return None
    return journal.extend([entry], number, (), record_checksum(entry))


def say(
    store: Store, match_id: str, decide: Callable[[Journal], Sequence[ReviewRecord]]
) -> Journal:
    """Return the journal with the records of `decide`, retried if another writer was first.

    It returns records for the current journal, possibly none; if it raises, nothing is written.
    """
    while True:
        journal = read_journal(store, match_id)
        records = decide(journal)
        after = append(store, journal, records) if records else journal
        if after is not None:
            return after


def _path(match_id: str, number: int) -> str:
    return f"reviews/{checked_name(match_id)}/{number:06d}.json"


def requests_by_id(records: Iterable[ReviewRecord]) -> dict[str, ReviewRequest]:
    """Return all review requests by id, first to last."""
    asked = (record for record in records if isinstance(record, ReviewRequest))
    return {request.id: request for request in asked}


def last_decision(
    records: Iterable[ReviewRecord], unit: str, content: str
) -> ReviewDecision | None:
    """Return the last verdict on a result's bytes in records in order, None without a decision.

    The unit is `stage/unit`, the content a digest of the result's files; its key may have changed.
    """
    about: set[str] = set()
    last = None
    for record in records:
        if isinstance(record, ReviewRequest) and record.contents.get(unit) == content:
            about.add(record.id)
        elif isinstance(record, ReviewDecision) and record.request in about:
            last = record
    return last
