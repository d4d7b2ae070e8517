"""Garbage collection: plan which results no kept run needs, then remove them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache, partial

from data_contracts.run import Reservation, RunRecord
from worldpose.errors import CorruptionError, InputError, StoreError
from worldpose.store.blobs import Entry
from worldpose.store.paths import MANIFEST, ResultId, is_name, record_path, reservation_path
from worldpose.store.runs import list_pins, may_be_running, run_files, run_order
from worldpose.store.store import Store


@dataclass(frozen=True)
class Garbage:
    """One item to remove."""

    path: str
    """A result's group, a staging folder, a run record or a reservation."""
    reason: str
    size: int
    """[byte]"""


@dataclass(frozen=True)
class GcPlan:
    """Items that `collect` will remove, and the matches that it skips."""

    garbage: tuple[Garbage, ...]
    held: tuple[str, ...]
    """One sentence per skipped match: a run of it may be in progress, or a record is unreadable."""
    runs: frozenset[str]
    """The run records, reservations and pins known to the plan."""

    @property
    def size(self) -> int:
        """Total size that it frees [byte]."""
        return sum(item.size for item in self.garbage)


def plan_gc(
    store: Store,
    *,
    keep_last: int | None = None,
    forget: Collection[str] = (),
    older_than: timedelta = timedelta(days=1),
) -> GcPlan:
    """Find garbage: results that no kept run reaches, leftovers and reservations of dead runs.

    A result is reached if a kept run's record names it or a result computed from it. A pinned run
    is kept, however old. Recent results and leftovers are kept; results are also kept while a run
    of their match may be in progress, which may be about to name them, and leftovers while any run
    may be. Reservations are kept while they hold the highest number, so that no number is reused
    unless `forget` frees it. A match is skipped if a kept run's record, a reservation, pin or
    manifest is damaged or of another version: the results that its runs reach are unknown. A record
    that `keep_last` drops need not be readable. Planning removes nothing.

    `keep_last` keeps only this many of each match's newest run records, the newest complete one
    with results of each stage, and all iterations of the last call; None keeps all. `forget` names
    runs to drop, as `match/0003`; an unfinished one counts as dead. Results and leftovers below the
    age `older_than` are kept. InputError if `forget` names a missing or pinned run.
    """
    known = _run_files(store)
    _check_arguments(store, keep_last, forget)
    sizes = {entry.path: entry.size for entry in store.blobs.entries("runs")}
    garbage: list[Garbage] = []
    active: list[Reservation] = []
    reached: set[ResultId] = set()
    damaged: dict[str, str] = {}
    for match_id in _matches_with_runs(sizes):
        read = cache(partial(store.run, match_id))
        try:
            dropped, kept = _select_runs(store, match_id, read, keep_last, forget)
            for run_id in kept:
                _add_reached_results(store, read(run_id), reached)
            reservations = list(_reservations(store, match_id, sizes))
        except (CorruptionError, InputError) as error:
            damaged[match_id] = f"Match {match_id} is skipped: {error}"
            continue
        for run_id in dropped:
            path = record_path(match_id, run_id)
            garbage.append(Garbage(path, "run forgotten", sizes[path]))
        for path, reservation in reservations:
            if reservation is None or f"{match_id}/{reservation.run_id}" in forget:
                garbage.append(Garbage(path, "reservation of a dead run", sizes[path]))
            elif may_be_running(reservation):
                active.append(reservation)
    before = datetime.now(UTC) - older_than
    spared = {*damaged, *(run.match_id for run in active)}
    garbage.extend(_find_unreached_results(store, reached, spared, before))
    garbage.extend(
        Garbage(entry.path, "staging of a dead writer", entry.size)
        for entry in store.blobs.staged_entries()
        if entry.modified <= before and not active  # staging does not tell its match
    )
    return GcPlan(tuple(garbage), (*map(_describe_active, active), *damaged.values()), known)


def _describe_active(run: Reservation) -> str:
    return (
        f"Match {run.match_id} is skipped: run {run.run_id} (process {run.pid} on {run.host}), "
        f"started at {run.started_at:%Y-%m-%d %H:%M} UTC, may still be active. If it is dead, "
        f"forget it: worldpose gc --delete --forget {run.match_id}/{run.run_id}"
    )


def collect(store: Store, plan: GcPlan) -> int:
    """Remove the items of `plan` and return the freed size [byte].

    Records are removed before the results that they name, manifests before their files: after any
    interruption, every readable result is whole, and the next plan finds the rest. StoreError if a
    run was started, ended or pinned since the plan was made; nothing is removed then.
    """
    if plan.runs != _run_files(store):
        raise StoreError(
            f"{store.url}: a run has started, ended or been pinned since the garbage collection "
            "was planned. Nothing was removed. Make a new plan."
        )
    for item in sorted(plan.garbage, key=lambda item: not item.path.startswith("runs/")):
        if item.path.startswith("runs/"):
            store.blobs.delete(item.path)
        else:
            store.blobs.delete_tree(item.path, MANIFEST)
    return plan.size


def _matches_with_runs(paths: Iterable[str]) -> list[str]:
    """Return the matches of files below `runs`, without folders of foreign files."""
    parts = (path.split("/") for path in paths)
    return sorted({each[1] for each in parts if len(each) == 3 and is_name(each[1])})


def _run_files(store: Store) -> frozenset[str]:
    """Return the paths of all files that define which runs exist and which are kept."""
    folders = (store.blobs.entries(top) for top in ("runs", "pins"))
    return frozenset(entry.path for entries in folders for entry in entries)


def _pin_names(store: Store, match_id: str) -> dict[str, str]:
    """Map each pinned run to one of its names."""
    return {pin.run_id: pin.name for pin in list_pins(store.blobs, match_id)}


def _check_arguments(store: Store, keep_last: int | None, forget: Collection[str]) -> None:
    if keep_last is not None and keep_last < 1:
        raise InputError(
            "keep_last",
            expected="an integer of at least 1",
            found=str(keep_last),
            todo="Keep at least one run.",
        )
    for name in forget:
        match_id, _, run_id = name.partition("/")
        finished, reserved, _ = run_files(store.blobs, match_id)
        if run_id not in (known := finished | reserved):
            raise InputError(
                f"run to forget: {name}",
                expected=f"match/run with one of the runs: {', '.join(sorted(known)) or '(none)'}",
                found="no such run",
                todo=f"List the runs: worldpose status {match_id}.",
            )
        if run_id in (pinned := _pin_names(store, match_id)):
            raise InputError(
                f"run to forget: {name}",
                expected="a run that is not pinned",
                found=f"a run pinned as {pinned[run_id]}",
                todo=f"Run first: worldpose unpin {match_id}/{pinned[run_id]}.",
            )


def _select_runs(
    store: Store,
    match_id: str,
    read: Callable[[str], RunRecord],
    keep_last: int | None,
    forget: Collection[str],
) -> tuple[list[str], list[str]]:
    """Return the ids of the finished runs to drop, and of those to keep."""
    finished, pinned = store.runs(match_id), _pin_names(store, match_id)
    wanted = [run_id for run_id in finished if f"{match_id}/{run_id}" not in forget]
    chosen = {*pinned, *wanted}
    if keep_last is not None:
        last = {*finished[-keep_last:], *_find_last_of_stages(read, wanted)}
        last |= {*_find_iterations(read, wanted)}
        chosen = {*pinned, *({*wanted} & last)}
    kept = [run_id for run_id in finished if run_id in chosen]
    return [run_id for run_id in finished if run_id not in kept], kept


def _find_last_of_stages(read: Callable[[str], RunRecord], run_ids: Sequence[str]) -> Iterator[str]:
    """Yield the newest complete runs with results of each stage; partial ones for other stages."""
    had: set[str] = set()
    for state in ("complete", "partial"):
        for run_id in reversed(run_ids):
            try:
                record = read(run_id)
            except (CorruptionError, InputError):  # if it is kept, its match is skipped
                continue
            stages = {name.partition("/")[0] for name in record.results}
            if record.state == state and stages - had:
                had |= stages
                yield run_id


def _find_iterations(read: Callable[[str], RunRecord], run_ids: Sequence[str]) -> Iterator[str]:
    """Yield the newest run of each iteration of the last call: the next call compares them all."""
    seen: set[int] = set()
    for run_id in reversed(run_ids):
        try:
            iteration = read(run_id).iteration
        except (CorruptionError, InputError):
            return
        if iteration not in seen:
            yield run_id
        elif iteration == 1:  # that of an earlier call
            return
        seen.add(iteration)


def _reservations(
    store: Store, match_id: str, known: Collection[str]
) -> Iterator[tuple[str, Reservation | None]]:
    """Yield path and reservation of a match's runs; None marks one that is no longer needed."""
    finished = store.runs(match_id)
    for run_id in finished:
        path = reservation_path(match_id, run_id)
        if path in known:
            yield path, None
    unfinished = store.unfinished_runs(match_id)
    numbers = (*finished, *(run.run_id for run in unfinished))
    for run in unfinished:
        is_spent = not may_be_running(run) and run.run_id != max(numbers, key=run_order)
        yield reservation_path(match_id, run.run_id), None if is_spent else run


def _add_reached_results(store: Store, record: RunRecord, reached: set[ResultId]) -> None:
    """Add to `reached` the results that a run names, and all their inputs."""
    waiting = [
        ResultId.from_name(record.match_id, name, key) for name, key in record.results.items()
    ]
    while waiting:
        result = waiting.pop()
        if result in reached:
            continue
        reached.add(result)
        # An input of an older, forgotten run may have been removed already.
        if store.has(result.match_id, result.stage, result.unit, result.key):
            recipe = store.manifest(result.match_id, result.stage, result.unit, result.key).recipe
            waiting.extend(
                ResultId.from_name(result.match_id, name, key)
                for name, key in recipe.inputs.items()
            )


def _find_unreached_results(
    store: Store, reached: set[ResultId], held: Collection[str], before: datetime
) -> Iterator[Garbage]:
    groups: dict[ResultId, list[Entry]] = {}
    for entry in store.blobs.entries("results"):
        result = ResultId.from_path(entry.path)
        if result and result not in reached and result.match_id not in held:
            groups.setdefault(result, []).append(entry)
    for result, entries in groups.items():
        if max(entry.modified for entry in entries) <= before:
            is_published = any(entry.path == result.manifest_path for entry in entries)
            reason = "no kept run reaches it" if is_published else "never published"
            yield Garbage(result.path, reason, sum(entry.size for entry in entries))
