"""Comparison of two projects: whether their computations give the same results."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from data_contracts.records import Record
from worldpose.store.paths import ResultId
from worldpose.store.store import Store

_TRANSIENT_FIELDS = {
    "manifest": {"created_at", "seconds", "run_id", "checksum"},
    "run": {"run_id", "parent", "executed", "reused", "started_at", "finished_at", "seconds"},
    "registration": {"folder", "files"},
}
"""Allowed differences between two valid runs: times, numbers, places, and reused units."""


def compare_stores(ours: Store, theirs: Store) -> list[str]:
    """Return one line per difference; empty if the projects are equal, byte for byte.

    Compared are the registered matches, every result's files and manifest, and the latest run of
    each match, which is the current one after interruptions. Ignored are times, run numbers and
    places, and whether a run computed or reused the units.
    """
    return [
        *_compare_matches(ours, theirs),
        *_compare_results(ours, theirs),
        *_compare_runs(ours, theirs),
    ]


def _compare_matches(ours: Store, theirs: Store) -> Iterator[str]:
    yield from _compare_names("match", ours.matches(), theirs.matches())
    for match_id in sorted({*ours.matches()} & {*theirs.matches()}):
        one, other = ours.registration(match_id), theirs.registration(match_id)
        if one and other:
            yield from _compare_fields(f"match {match_id}", one, other, "registration")
            yield from _compare_values(
                f"match {match_id}",
                {file.path: file.sha256 for file in one.files},
                {file.path: file.sha256 for file in other.files},
            )


def _compare_results(ours: Store, theirs: Store) -> Iterator[str]:
    yield from _compare_names("result", _result_paths(ours), _result_paths(theirs))
    for result in sorted({*ours.results()} & {*theirs.results()}):
        manifests = [
            store.manifest(result.match_id, result.stage, result.unit, result.key)
            for store in (ours, theirs)
        ]
        yield from _compare_fields(result.path, manifests[0], manifests[1], "manifest")
        yield from _compare_files(result, ours, theirs)


def _compare_runs(ours: Store, theirs: Store) -> Iterator[str]:
    for match_id in sorted({*_matches_with_runs(ours)} | {*_matches_with_runs(theirs)}):
        finished = [store.runs(match_id) for store in (ours, theirs)]
        if all(finished):
            yield from _compare_fields(
                f"latest run of {match_id}", ours.run(match_id), theirs.run(match_id), "run"
            )
        elif any(finished):
            having = "first" if finished[0] else "second"
            yield f"match {match_id}: only the {having} project has finished runs"


def _matches_with_runs(store: Store) -> Iterator[str]:
    for entry in store.blobs.entries("runs"):
        yield entry.path.split("/")[1]


def _result_paths(store: Store) -> list[str]:
    return [result.path for result in store.results()]


def _compare_files(result: ResultId, ours: Store, theirs: Store) -> Iterator[str]:
    names = []
    for store in (ours, theirs):
        entries = store.blobs.entries(result.path)
        names.append({entry.path for entry in entries} - {result.manifest_path})
    yield from _compare_names("file", names[0], names[1])
    for path in sorted(names[0] & names[1]):
        one, other = ours.blobs.read(path), theirs.blobs.read(path)
        if one == other:
            continue
        if path.endswith("/zarr.json") and one and other:
            yield from _compare_values(path, json.loads(one), json.loads(other))
        else:
            yield f"{path}: the bytes differ"


def _compare_names(kind: str, ours: Iterable[str], theirs: Iterable[str]) -> Iterator[str]:
    yield from (f"{kind} {name}: only in the first project" for name in sorted({*ours} - {*theirs}))
    yield from (
        f"{kind} {name}: only in the second project" for name in sorted({*theirs} - {*ours})
    )


def _compare_fields(where: str, ours: Record, theirs: Record, kind: str) -> Iterator[str]:
    excluded = _TRANSIENT_FIELDS[kind]
    yield from _compare_values(
        where,
        ours.model_dump(mode="json", exclude=excluded),
        theirs.model_dump(mode="json", exclude=excluded),
    )


def _compare_values(
    where: str, ours: Mapping[str, Any], theirs: Mapping[str, Any]
) -> Iterator[str]:
    for name in sorted(ours.keys() | theirs.keys()):
        one, other = ours.get(name), theirs.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            yield from _compare_values(f"{where}: {name}", one, other)
        elif one != other:
            yield f"{where}: {name}: {one!r} in the first project, {other!r} in the second"
