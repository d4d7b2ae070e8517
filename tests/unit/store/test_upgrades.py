"""Projects of another version of worldpose open, or are refused with the reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from store_samples import place, publish, run_once, sample_recipe, sample_record

from data_contracts.review import ReviewDecision
from data_contracts.run import UnitFailure
from worldpose.errors import InputError
from worldpose.review.journal import append, read_journal
from worldpose.store import Store, recipe_key, verify
from worldpose.store.documents import canonical_json, digest

NOW = "2026-01-01T00:00:00Z"


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
    with pytest.raises(InputError, match=r"store_format.*expected '1', found '0'") as refused:
        Store.open(folder_store.url)
    assert "Use the version of worldpose that made the project" in str(refused.value)
    with pytest.raises(InputError, match="store_format"):
        Store.create(folder_store.url)


def test_a_run_that_an_earlier_version_recorded_opens(folder_store: Store) -> None:
    # Records before a failed unit's key, gates, questions and iterations existed.
    failure = UnitFailure(unit="tracking/late", error="StoreError", message="x")
    recipe = sample_recipe()
    publish(folder_store, recipe)
    folder_store.finish_run(sample_record("0001", recipe, state="partial", failed=(failure,)))

    def earlier(fields: dict[str, Any]) -> None:
        for name in ("iteration", "gates", "waiting"):
            del fields[name]
        del fields["failed"][0]["key"]

    rewrite(folder_store, "runs/final/0001.json", earlier)
    record = folder_store.run("final")
    assert (record.iteration, record.gates, record.waiting) == (1, "never", ())
    assert record.failed[0].key is None
    assert verify(folder_store) == ()


def test_a_run_that_a_later_version_recorded_is_refused_as_such(folder_store: Store) -> None:
    run_once(folder_store)
    rewrite(folder_store, "runs/final/0001.json", lambda fields: fields.update(mood="good"))
    with pytest.raises(InputError, match="found the fields mood of a later version"):
        folder_store.run("final")
    # It is not damaged, but it is said.
    (finding,) = verify(folder_store)
    assert "later version" in finding.problem


def test_results_of_other_code_are_never_taken_for_ours(folder_store: Store) -> None:
    run_once(folder_store)
    ours = sample_recipe()
    for part in ("code", "libraries"):
        other = ours.model_copy(update={part: {**getattr(ours, part), "numpy": "another"}})
        assert recipe_key(other) != recipe_key(ours)
        assert not folder_store.has(*place(other))


def test_a_journal_of_a_version_with_fewer_fields_is_whole(folder_store: Store) -> None:
    # An entry is sealed as its version wrote it: a field that was added since is in no checksum.
    said = {"request": "tracking.clip.1", "verdict": "approve", "who": "Ada", "decided_at": NOW}
    for number in (1, 2):
        decision = ReviewDecision.model_validate({"match_id": "final", **said})
        append(folder_store, read_journal(folder_store, "final"), [decision])
        path = f"reviews/final/{number:06d}.json"
        rewrite(folder_store, path, lambda fields: fields["records"][0].pop("why"))
    assert verify(folder_store) == ()
    assert [record.why for record in read_journal(folder_store, "final").questions] == ["", ""]
