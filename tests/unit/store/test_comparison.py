from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from store_comparison import compare_stores
from store_samples import place, run_once, sample_recipe, sample_record, sample_registration

from worldpose.store.paths import ResultId
from worldpose.store.store import Store

TOP = ResultId(*place()).path


def filled(store: Store, folder: str) -> Store:
    store.register(sample_registration(folder=folder))
    run_once(store)
    return store


def test_times_places_and_numbers_of_runs_do_not_count(store: Store, tmp_path: Path) -> None:
    other = filled(Store.create(tmp_path / "other"), "/there")
    run_once(other)
    assert compare_stores(filled(store, "/here"), other) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda store: store.blobs.put(f"{TOP}/joints/c/0/0/0", b"x"), f"{TOP}/joints/c/0/0/0"),
        (lambda store: store.blobs.delete(f"{TOP}/views/c/0"), f"{TOP}/views/c/0"),
        (lambda store: store.blobs.put(f"{TOP}/more", b"more"), f"{TOP}/more"),
        (lambda store: store.withdraw(ResultId(*place())), f"{TOP}: content"),
        (
            lambda store: store.finish_run(
                sample_record("0002", sample_recipe(), state="partial", waiting=())
            ),
            "latest run of final: state",
        ),
        (lambda store: store.blobs.delete("runs/final/0001.json"), "latest run of final: state"),
        (lambda store: store.blobs.delete("matches/final.json"), "match final: identity"),
    ],
)
def test_every_other_difference_is_named(
    folder_store: Store, tmp_path: Path, change: Callable[[Store], None], named: str
) -> None:
    other = filled(Store.create(tmp_path / "other"), "/there")
    change(filled(folder_store, "/here"))
    assert any(line.startswith(f"{named}: ") for line in compare_stores(folder_store, other))
