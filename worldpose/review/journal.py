"""The journal of a match: what people said, added entry by entry, never changed.

Each entry is one sealed file, `reviews/<match>/<number>.json`, created whole and durable or not at
all, on a disk and in object storage alike; creation fails where another writer took the number, so
that no entry is lost. Each names the checksum of the one before it, so that a lost or changed entry
is seen.

A process keeps what it has read: each further look reads the last entry it knows and those that any
process added since.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from worldpose.store import Store
from worldpose.store.documents import checksum_of, read_checksum, seal, unseal
from worldpose.store.paths import checked_name

_ENTRY = re.compile(r"(\d{6,})\.json")
READERS = 8
"""Entries fetched at a time: in object storage each is a request of its own."""
BATCH = 64
"""Entries that one reader fetches in a row."""


@dataclass(frozen=True)
class Journal:
    """What the journal of a match holds.

    Attributes:
        match_id: the match.
        entries: the whole entries, first to last.
        last: the highest number taken, by a whole entry or a damaged one.
        damage: a line for each entry that is cut short, ignored, and to be said again.
        tip: checksum of the last whole entry, on which the next one builds.
        questions: the requests and decisions among the records, in order.
        corrections: id to correction, also of those that were taken back.
        standing: id to correction, in the order they were made, without those that were taken back.
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
        """All that was said, in order."""
        for entry in self.entries:
            yield from entry.records

    def extended(
        self, entries: Sequence[JournalEntry], last: int, damage: Sequence[str], tip: str | None
    ) -> Journal:
        """Return the journal with further entries; what it says is not gathered again.

        Args:
            entries: the whole ones among them.
            last: the highest number taken.
            damage: a line for each further damaged entry.
            tip: checksum of the last whole entry.
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
    """The journal of a match, empty before its first entry.

    A damaged entry that no later one builds on was never acknowledged, or its disk lost it: it is
    ignored and told in `damage`.

    A store object is given what it has read before, as long as the last entry is still the same;
    only later ones are read. So damage that an earlier entry takes meanwhile is seen by `verify`
    and by the next process.

    Raises:
        CorruptionError: an entry that a later one builds on is damaged or gone.
        InputError: an entry of another contract version.
    """
    folder = f"reviews/{checked_name(match_id)}"
    with _KNOWN_LOCK:
        known = _KNOWN.setdefault(store, {}).setdefault(match_id, _Known())
    with known.lock:  # requests that come at once read a long journal once
        journal = known.journal or Journal(match_id)
        if not _is_still(store, journal, known.last_data):
            journal, known.last_data = Journal(match_id), None
            names = (entry.path.rpartition("/")[2] for entry in store.blobs.entries(folder))
            numbers = sorted(int(found[1]) for found in map(_ENTRY.fullmatch, names) if found)
        else:
            numbers = []
        found = _contents(store, match_id, numbers)
        while (data := store.blobs.read(_path(match_id, _last(journal, found) + 1))) is not None:
            found.append((_last(journal, found) + 1, data))
        journal = _extended(journal, found, f"{store.url}/{folder}")
        known.last_data = found[-1][1] if found else known.last_data
        known.journal = journal
        return journal


@dataclass
class _Known:
    """What a store object has read of a journal.

    Attributes:
        journal: None before the first look.
        last_data: the bytes of its last entry, None where there is none.
        lock: held by the one that reads.
    """

    journal: Journal | None = None
    last_data: bytes | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)


_KNOWN: WeakKeyDictionary[Store, dict[str, _Known]] = WeakKeyDictionary()
_KNOWN_LOCK = threading.Lock()


def _contents(store: Store, match_id: str, numbers: Sequence[int]) -> list[tuple[int, bytes]]:
    """Entries that are listed, with their bytes; none for one that is gone meanwhile."""

    def read(some: Sequence[int]) -> list[tuple[int, bytes]]:
        return [(number, store.blobs.read(_path(match_id, number)) or b"") for number in some]

    batches = [numbers[first : first + BATCH] for first in range(0, len(numbers), BATCH)]
    with ThreadPoolExecutor(READERS) as pool:
        return [each for some in pool.map(read, batches) for each in some]


def _is_still(store: Store, journal: Journal, last_data: bytes | None) -> bool:
    """Is the last known entry there as it was; of an empty journal nothing is known."""
    return journal.last > 0 and store.blobs.read(_path(journal.match_id, journal.last)) == last_data


def _last(journal: Journal, found: Sequence[tuple[int, bytes]]) -> int:
    return found[-1][0] if found else journal.last


def _extended(journal: Journal, found: Sequence[tuple[int, bytes]], folder: str) -> Journal:
    """The journal with further entries: the number of each, and its bytes."""
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
                f"{where} builds on an entry that is gone or damaged; {whole} before it are "
                f"whole. Restore the folder {folder} from a copy."
            )
        entries.append(entry)
        tip = read_checksum(data)
    return journal.extended(entries, found[-1][0], damage, tip)


def append(store: Store, journal: Journal, records: Sequence[ReviewRecord]) -> Journal | None:
    """The journal with one more entry, durable when this returns.

    Args:
        store: where it lies.
        journal: as it was read; what `records` say was decided on it.
        records: said at once: all of them are kept, or none.

    Returns:
        None when somebody said something since: nothing is written; read it again and decide anew.

    Raises:
        StoreError: the store cannot take it; nothing is written.
    """
    number = journal.last + 1
    entry = JournalEntry(
        match_id=journal.match_id,
        number=number,
        previous=journal.tip,
        records=tuple(records),
    )
    if not store.blobs.put_new(_path(journal.match_id, number), seal(entry)):
        return None
    return journal.extended([entry], number, (), checksum_of(entry))


def say(
    store: Store, match_id: str, decide: Callable[[Journal], Sequence[ReviewRecord]]
) -> Journal:
    """The journal with what `decide` says of it, decided again whenever somebody was quicker.

    Args:
        store: where it lies.
        match_id: the match.
        decide: gives what is to be said, from the journal as it is; nothing to say is fine. What
            it raises is raised here, and nothing is written.
    """
    while True:
        journal = read_journal(store, match_id)
        records = decide(journal)
        after = append(store, journal, records) if records else journal
        if after is not None:
            return after


def _path(match_id: str, number: int) -> str:
    return f"reviews/{checked_name(match_id)}/{number:06d}.json"
