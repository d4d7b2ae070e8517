from __future__ import annotations

from pathlib import Path

import pytest
from store_comparison import compare_stores
from store_samples import (
    place,
    publish,
    run_once,
    sample_recipe,
    sample_record,
    sample_registration,
)

from worldpose.store.paths import ResultId
from worldpose.store.store import Store


def filled(store: Store, folder: str) -> Store:
    store.register(sample_registration(folder=folder))
    run_once(store)
    return store


@pytest.fixture
def twins(folder_store: Store, tmp_path: Path) -> tuple[Store, Store]:
    return filled(folder_store, "/here"), filled(Store.create(tmp_path / "other"), "/there")


def test_folder_and_object_storage_hold_the_same(store: Store, tmp_path: Path) -> None:
    other = Store.create(tmp_path / "other")
    assert compare_stores(filled(store, "/here"), filled(other, "/there")) == []


def test_times_and_numbers_of_runs_do_not_count(twins: tuple[Store, Store]) -> None:
    run_once(twins[0])
    assert compare_stores(*twins) == []


def test_changed_chunk_is_a_difference(twins: tuple[Store, Store]) -> None:
    path = f"{ResultId(*place()).path}/joints/c/0/0/0"
    twins[1].blobs.put(path, b"changed")
    assert compare_stores(*twins) == [f"{path}: the bytes differ"]


def test_changed_attribute_is_a_difference_that_is_named(twins: tuple[Store, Store]) -> None:
    path = f"{ResultId(*place()).path}/joints/zarr.json"
    data = twins[1].blobs.read(path)
    assert data is not None
    twins[1].blobs.put(path, data.replace(b'"unit": "m"', b'"unit": "px"'))
    assert compare_stores(*twins) == [
        f"{path}: attributes: unit: 'm' in the first project, 'px' in the second"
    ]


def test_lost_and_added_files_are_differences(twins: tuple[Store, Store]) -> None:
    top = ResultId(*place()).path
    twins[0].blobs.delete(f"{top}/views/c/0")
    twins[0].blobs.put(f"{top}/more", b"more")
    assert compare_stores(*twins) == [
        f"file {top}/more: only in the first project",
        f"file {top}/views/c/0: only in the second project",
    ]


def test_lost_result_is_a_difference(twins: tuple[Store, Store]) -> None:
    twins[0].withdraw(ResultId(*place()))
    assert compare_stores(*twins) == [
        f"result {ResultId(*place()).path}: only in the second project"
    ]


def test_other_content_of_one_key_is_a_difference(folder_store: Store, tmp_path: Path) -> None:
    other = Store.create(tmp_path / "other")
    publish(folder_store, seed=0)
    publish(other, seed=1)
    lines = compare_stores(folder_store, other)
    assert any("content" in line for line in lines)
    assert any("joints/c/0/0/0: the bytes differ" in line for line in lines)


def test_other_run_is_a_difference(twins: tuple[Store, Store]) -> None:
    twins[0].finish_run(sample_record("0002", sample_recipe(), state="partial"))
    assert compare_stores(*twins) == [
        "latest run of final: state: 'partial' in the first project, 'complete' in the second"
    ]


def test_absent_run_and_match_are_differences(twins: tuple[Store, Store]) -> None:
    twins[0].blobs.delete("runs/final/0001.json")
    twins[0].blobs.delete("matches/final.json")
    assert compare_stores(*twins) == [
        "match final: only in the second project",
        "match final: only the second project has finished runs",
    ]
