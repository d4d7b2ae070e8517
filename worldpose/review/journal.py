"""The journal of a match: what people said, added entry by entry, never changed.

Each entry is one sealed file, `reviews/<match>/<number>.json`, created whole and durable or not at
all, on a disk and in object storage alike; creation fails where another writer took the number, so
that no entry is lost. Each names the checksum of the one before it, so that a lost or changed entry
is seen.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from data_contracts.review import JournalEntry, ReviewRecord
from worldpose.errors import CorruptionError
from worldpose.store import Store
from worldpose.store.documents import checksum_of, seal, unseal
from worldpose.store.paths import checked_name

_ENTRY = re.compile(r"(\d{6,})\.json")
READERS = 8
"""Entries fetched at a time: in object storage each is a request of its own."""


@dataclass(frozen=True)
class Journal:
    """What the journal of a match holds.

    Attributes:
        match_id: the match.
        entries: the whole entries, first to last.
        last: the highest number taken, by a whole entry or a damaged one.
        damage: a line for each entry that is cut short, ignored, and to be said again.
    """

    match_id: str
    entries: tuple[JournalEntry, ...] = ()
    last: int = 0
    damage: tuple[str, ...] = ()

    @property
    def records(self) -> Iterator[ReviewRecord]:
        """All that was said, in order."""
        for entry in self.entries:
            yield from entry.records


def read_journal(store: Store, match_id: str) -> Journal:
    """The journal of a match, empty before its first entry.

    A damaged entry that no later one builds on was never acknowledged, or its disk lost it: it is
    ignored and told in `damage`.

    Raises:
        CorruptionError: an entry that a later one builds on is damaged or gone.
        InputError: an entry of another contract version.
    """
    folder = f"reviews/{checked_name(match_id)}"
    names = (entry.path.rpartition("/")[2] for entry in store.blobs.entries(folder))
    numbers = sorted(int(found[1]) for found in map(_ENTRY.fullmatch, names) if found)
    with ThreadPoolExecutor(READERS) as pool:
        contents = list(pool.map(store.blobs.read, (_path(match_id, n) for n in numbers)))
    entries: list[JournalEntry] = []
    damage = []
    for number, data in zip(numbers, contents, strict=True):
        where = f"{store.url}/{_path(match_id, number)}"
        try:
            entry = unseal(JournalEntry, data or b"", where)
        except CorruptionError as error:
            damage.append(f"{error}; it is ignored: what it said must be said again")
            continue
        if (entry.match_id, entry.number) != (match_id, number):
            raise CorruptionError(f"{where} is entry {entry.number} of {entry.match_id}")
        if entry.previous != _tip(entries):
            raise CorruptionError(
                f"{where} builds on an entry that is gone or damaged; entries "
                f"{[each.number for each in entries]} before it are whole. Restore the folder "
                f"{folder} from a copy."
            )
        entries.append(entry)
    return Journal(match_id, tuple(entries), max(numbers, default=0), tuple(damage))


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
        previous=_tip(journal.entries),
        records=tuple(records),
    )
    if not store.blobs.put_new(_path(journal.match_id, number), seal(entry)):
        return None
    return Journal(journal.match_id, (*journal.entries, entry), number, journal.damage)


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


def _tip(entries: Sequence[JournalEntry]) -> str | None:
    return checksum_of(entries[-1]) if entries else None
