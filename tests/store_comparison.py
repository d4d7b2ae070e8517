"""Comparison of two projects: whether their computations give the same results."""

import json
from typing import Any

from worldpose.store.documents import digest

_TRANSIENT_FIELDS = {
    "manifest": {"created_at", "seconds", "run_id", "checksum"},
    "run": {"run_id", "parent", "executed", "reused", "started_at", "finished_at", "seconds"},
    "registration": {"folder", "files"},
}
"""Allowed differences between two valid runs: times, numbers, places, and reused units."""


def compare_stores(ours, theirs):
    """Return one line per difference; empty if the projects are equal, byte for byte.

    Compared are the registered matches, every result's files and manifest, and the latest run of
    each match, which is the current one after interruptions. Ignored are times, run numbers and
    places, and whether a run computed or reused the units.
    """
    one, other = _describe(ours), _describe(theirs)
    return [
        f"{name}: {one.get(name)} in the first project, {other.get(name)} in the second"
        for name in sorted(one.keys() | other.keys())
        if one.get(name) != other.get(name)
    ]


def _describe(store):
    """Return the content of a project by path or name; that of files as their digests."""
    found: dict[str, Any] = {}
    for match_id in store.matches():
        registration = store.registration(match_id)
        assert registration is not None
        found |= _fields(f"match {match_id}", registration, "registration")
        found |= {f"match {match_id}: {file.path}": file.sha256 for file in registration.files}
    for result in store.results():
        parts = (result.match_id, result.stage, result.unit, result.key)
        found |= _fields(result.path, store.manifest(*parts), "manifest")
        for entry in store.blobs.entries(result.path):
            if entry.path != result.manifest_path:
                found[entry.path] = digest(store.blobs.read(entry.path) or b"")
    for match_id in {entry.path.split("/")[1] for entry in store.blobs.entries("runs")}:
        if store.runs(match_id):
            found |= _fields(f"latest run of {match_id}", store.run(match_id), "run")
    return found


def _fields(where, record, kind):
    fields = record.model_dump(mode="json", exclude=_TRANSIENT_FIELDS[kind])
    return {f"{where}: {name}": json.dumps(value)[:500] for name, value in fields.items()}
