"""Verification of a project: find every changed, lost or foreign file, and repair the project."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from data_contracts.match import Registration
from data_contracts.operations import Heartbeat, QueuedRun
from data_contracts.pin import Pin
from data_contracts.review import JournalEntry
from data_contracts.run import Project, Reservation, RunRecord
from worldpose.errors import CorruptionError, InputError, StoreError
from worldpose.store.blobs import Entry
from worldpose.store.documents import read_checksum, unseal, verify_published
from worldpose.store.paths import (
    DAMAGED,
    MANIFEST,
    PROJECT,
    ResultId,
    damaged_path,
    is_name,
    queue_path,
)
from worldpose.store.runs import is_run_file
from worldpose.store.store import Store
from worldpose.store.writer import content_digest

Progress = Callable[[int, int], None]
"""Called with the number of verified bytes, and the total."""

FOREIGN: Final = "remove it: it is not the project's"

SealedEntry = tuple[JournalEntry, str]
"""A journal entry, and the checksum in its document."""


@dataclass(frozen=True)
class Finding:
    """A deviation from the published state."""

    path: str
    """Relative to the project."""
    problem: str
    result: ResultId | None = None
    """The damaged result; None for records, foreign files, and what could not be read."""
    is_damaged_record: bool = False
    """It is a run record, reservation, registration, pin or state of the queue that is not readable
    as such."""

    @property
    def can_be_repaired(self) -> bool:
        """Whether `repair` withdraws or sets aside what has it; the rest is for people to do."""
        return self.result is not None or self.is_damaged_record


def verify(
    store: Store, match_id: str | None = None, progress: Progress | None = None
) -> tuple[Finding, ...]:
    """Return all damage in a project, or in one match of it; empty if nothing has changed.

    Reads everything: each result's files against its manifest, each manifest, run record, pin,
    journal entry, reservation, registration and state of the queue against its own checksum, and
    each run record's results.
    """
    below = "" if match_id is None else f"/{match_id}"
    # Results last: an active run publishes them before the record that names them.
    documents = [
        *(store.blobs.entries("matches") if match_id is None else []),
        *store.blobs.entries("queue" if match_id is None else f"queue/match/{match_id}"),
        *store.blobs.entries(f"runs{below}"),
        *store.blobs.entries(f"reviews{below}"),
        *store.blobs.entries(f"pins{below}"),
    ]
    results = store.blobs.entries(f"results{below}")
    total = sum(entry.size for entry in (*results, *documents))
    done = 0
    findings: list[Finding] = []
    groups, strays = _by_result(results)
    findings.extend(Finding(path, f"is not part of any result; {FOREIGN}") for path in strays)
    for result, entries in groups.items():
        findings.extend(_check_result(store, result, entries))
        done += sum(entry.size for entry in entries.values())
        if progress:
            progress(done, total)
    journals: dict[str, list[SealedEntry]] = {}
    published = {result for result, entries in groups.items() if result.manifest_path in entries}
    if match_id is None:
        findings.extend(_check_document(store, PROJECT, published, journals))
    for entry in documents:
        findings.extend(_check_document(store, entry.path, published, journals))
        done += entry.size
        if progress:
            progress(done, total)
    for journal in journals.values():
        findings.extend(_check_chain(journal))
    return tuple(sorted(findings, key=lambda finding: (finding.path, finding.problem)))


def repair(
    store: Store, findings: Iterable[Finding]
) -> tuple[tuple[ResultId, ...], tuple[str, ...]]:
    """Withdraw damaged results and set damaged records aside; return results, and record paths.

    Both happen only if a second reading finds the damage too: the disk may have been away for a
    moment. The next run recomputes only the withdrawn results. A record that is set aside
    keeps its bytes under another name (`damaged_path`) in the same folder, and a run keeps its
    number. Journal entries stay: decisions of people are restored from a copy, never dropped.
    """
    findings = list(findings)
    damaged = {finding.result for finding in findings if finding.result}
    results = sorted(result for result in damaged if _is_damaged(store, result))
    for result in results:
        store.withdraw(result)
    set_aside = []
    for path in sorted({finding.path for finding in findings if finding.is_damaged_record}):
        again = _check_document(store, path, set(), {})
        is_damaged = any(finding.is_damaged_record for finding in again)
        if is_damaged and (data := store.blobs.read(path)) is not None:
            store.blobs.put(damaged_path(path), data)
            store.blobs.delete(path)
            set_aside.append(path)
    return tuple(results), tuple(set_aside)


def _is_damaged(store: Store, result: ResultId) -> bool:
    entries = {entry.path: entry for entry in store.blobs.entries(result.path)}
    return any(finding.result for finding in _check_result(store, result, entries))


def _by_result(entries: Iterable[Entry]) -> tuple[dict[ResultId, dict[str, Entry]], list[str]]:
    groups: dict[ResultId, dict[str, Entry]] = {}
    strays = []
    for entry in entries:
        result = ResultId.from_path(entry.path)
        if result is None:
            strays.append(entry.path)
        else:
            groups.setdefault(result, {})[entry.path] = entry
    return groups, strays


def _check_result(
    store: Store, result: ResultId, entries: Mapping[str, Entry]
) -> Iterator[Finding]:
    """Yield deviations; a file that cannot be read, or that is foreign, damages no result."""
    if result.manifest_path not in entries:
        # Not published: left by an interrupted writer in object storage; `gc` removes it.
        return
    try:
        manifest = store.manifest(result.match_id, result.stage, result.unit, result.key)
    except (StoreError, InputError) as error:
        is_damage = isinstance(error, CorruptionError)  # not a disk's error, or another version
        problem = getattr(error, "problem", str(error))
        yield Finding(result.manifest_path, problem, result if is_damage else None)
        return
    if content_digest(manifest.files) != manifest.content:
        yield Finding(
            result.manifest_path, "its content digest differs from the digest of its files", result
        )
    for file in manifest.files:
        try:
            verify_published(store.blobs, result, file)
        except StoreError as error:
            is_damage = isinstance(error, CorruptionError)
            problem = getattr(error, "problem", str(error))
            yield Finding(f"{result.path}/{file.path}", problem, result if is_damage else None)
    known = {
        f"{result.path}/{name}" for name in (MANIFEST, *(file.path for file in manifest.files))
    }
    for path in entries.keys() - known:
        yield Finding(path, f"was not published with this result; {FOREIGN}")


def _check_document(
    store: Store, path: str, published: set[ResultId], journals: dict[str, list[SealedEntry]]
) -> Iterator[Finding]:
    where, parts = f"{store.url}/{path}", path.split("/")
    is_record = False
    try:
        if path.endswith(DAMAGED) and parts[0] in ("matches", "runs", "pins", "queue"):
            return  # set aside: it has no reader
        data = store.blobs.read(path)
        if data is None and parts[0] in ("runs", "pins", "queue"):
            return  # ended, forgotten or unpinned since it was listed
        if data is None:
            raise CorruptionError(f"{where} is missing")
        match parts:
            case [name] if name == PROJECT:
                unseal(Project, data, where)
                return
            case ["matches", name] if _is_json(name):
                is_record = True
                registration = unseal(Registration, data, where)
                fits = name == f"{registration.spec.match_id}.json"
            case ["runs", match_id, name] if name.endswith(".open.json") and is_run_file(name):
                is_record = True
                reservation = unseal(Reservation, data, where)
                fits = (match_id, name) == (reservation.match_id, f"{reservation.run_id}.open.json")
            case ["runs", match_id, name] if is_run_file(name):
                is_record = True
                record = unseal(RunRecord, data, where)
                fits = (match_id, name) == (record.match_id, f"{record.run_id}.json")
                yield from _check_named_results(record, path, published)
            case ["reviews", match_id, name] if _is_json(name):
                entry = unseal(JournalEntry, data, where)
                fits = (match_id, name) == (entry.match_id, f"{entry.number:06d}.json")
                journals.setdefault(match_id, []).append((entry, read_checksum(data)))
            case ["pins", match_id, name] if _is_json(name):
                is_record = True
                pin = unseal(Pin, data, where)
                fits = (match_id, name) == (pin.match_id, f"{pin.name}.json")
            case ["queue", *_, name] if name.endswith(".beat.json"):
                is_record = True
                unseal(Heartbeat, data, where)
                return
            case ["queue", *_, name] if name.endswith(".json"):
                is_record = True
                queued = unseal(QueuedRun, data, where)
                fits = path == queue_path(queued)
            case _:
                yield Finding(path, f"is not a file of a project; {FOREIGN}")
                return
        if not fits:
            raise CorruptionError(
                f"{where} holds the record of another match, run, entry or pin than its path says"
            )
    except CorruptionError as error:
        restore = "; restore it from a copy" if parts[0] in ("reviews", PROJECT) else ""
        yield Finding(path, f"{error}{restore}", is_damaged_record=is_record)
    except (StoreError, InputError) as error:
        yield Finding(path, str(error))


def _is_json(name: str) -> bool:
    return name.endswith(".json") and is_name(name)


def _check_chain(entries: list[SealedEntry]) -> Iterator[Finding]:
    """Yield journal entries whose predecessor is missing or damaged."""
    tip = None
    for entry, checksum in sorted(entries, key=lambda sealed: sealed[0].number):
        if entry.previous != tip:
            path = f"reviews/{entry.match_id}/{entry.number:06d}.json"
            yield Finding(path, "its previous entry is missing or damaged; restore it from a copy")
        tip = checksum


def _check_named_results(
    record: RunRecord, path: str, published: set[ResultId]
) -> Iterator[Finding]:
    for name, key in record.results.items():
        result = ResultId.from_name(record.match_id, name, key)
        if result not in published:
            problem = (
                f"names {result.path}, which is not published; a run of the match with the "
                "settings of this run publishes it again; or unpin this run, and forget it: "
                f"worldpose gc --forget {record.match_id}/{record.run_id} --delete"
            )
            yield Finding(path, problem)
