"""Projects and records of another version of worldpose are refused with the reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from store_samples import run_once

from worldpose.errors import InputError
from worldpose.store.documents import canonical_json, digest
from worldpose.store.integrity import verify
from worldpose.store.store import Store


def rewrite(store: Store, path: str, change: Callable[[dict[str, Any]], None]) -> None:
    """A document as another version would have sealed it."""
    fields = json.loads(store.blobs.read(path) or b"")
    del fields["checksum"]
    change(fields)
    sealed = {**fields, "checksum": digest(canonical_json(fields))}
    store.blobs.put(path, canonical_json(sealed) + b"\n")


def test_a_store_of_another_format_is_refused_before_anything_is_read(folder_store: Store) -> None:
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
def test_a_run_that_another_version_recorded_is_refused_as_such(
    folder_store: Store, change: Callable[[dict[str, Any]], None], found: str
) -> None:
    run_once(folder_store)
    rewrite(folder_store, "runs/final/0001.json", change)
    with pytest.raises(InputError, match=f"found {found}: another version") as refused:
        folder_store.run("final")
    assert "worldpose run FOLDER --project NEW" in str(refused.value)
    # It is not damaged, but it is said.
    (finding,) = verify(folder_store)
    assert "another version" in finding.problem
