from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from store_samples import run_once, sample_arrays, sample_recipe, sample_record

import worldpose
from data_contracts.run import UnitFailure
from worldpose.errors import InputError, UsageError
from worldpose.store import Store


def test_run_gives_its_results_by_unit(store: Store) -> None:
    run_once(store, sample_recipe("late"), sample_recipe())
    run = worldpose.open_run(store.url, "final")
    assert list(run) == ["tracking/clip", "tracking/late"]
    assert len(run) == 2
    assert run.record.run_id == "0001"
    assert "tracking/clip" in run
    np.testing.assert_array_equal(run["tracking/clip"].joints, sample_arrays()["joints"])
    assert run["tracking/clip"] is run["tracking/clip"]
    assert "Run 0001 of match final: complete" in repr(run)
    assert "tracking/late" in repr(run)


def test_older_run_stays_open_to_readers(folder_store: Store) -> None:
    run_once(folder_store, sample_recipe("one"))
    run_once(folder_store, sample_recipe("two"))
    assert list(worldpose.open_run(folder_store.url, "final", "0001")) == ["tracking/one"]


def test_result_of_an_earlier_version_is_refused_where_all_of_it_is_needed(
    folder_store: Store,
) -> None:
    run_once(folder_store)
    assert "joints" in worldpose.open_run(folder_store.url, "final")["tracking/clip"]
    run = worldpose.open_run(folder_store.url, "final", complete=True)
    with pytest.raises(UsageError, match=r"earlier version, without joins, .*worldpose run final"):
        run["tracking/clip"]


def test_absent_unit_says_what_there_is(folder_store: Store) -> None:
    failure = UnitFailure(unit="tracking/bad", error="InputError", message="no detections")
    run_once(folder_store)
    folder_store.finish_run(
        sample_record("0002", sample_recipe(), state="partial", failed=(failure,))
    )
    run = worldpose.open_run(folder_store.url, "final")
    assert "tracking/bad" not in run
    assert run.get("tracking/bad") is None
    with pytest.raises(KeyError, match="it failed with InputError: no detections"):
        run["tracking/bad"]
    with pytest.raises(KeyError, match="the run has tracking/clip"):
        run["tracking/other"]
    assert "tracking/bad  failed: InputError" in repr(run)


def test_absent_project_and_match_say_what_to_do(tmp_path: Path, folder_store: Store) -> None:
    with pytest.raises(InputError, match="worldpose init"):
        worldpose.open_run(tmp_path / "nowhere", "final")
    with pytest.raises(InputError, match="worldpose run semi"):
        worldpose.open_run(folder_store.url, "semi")


def test_library_has_no_other_names() -> None:
    with pytest.raises(AttributeError, match="no attribute 'open_runs'"):
        worldpose.open_runs  # noqa: B018


def test_neither_the_library_nor_the_store_imports_zarr_until_arrays_are_used() -> None:
    code = (
        "import sys, worldpose, worldpose.store\n"
        "sys.exit(bool({'zarr', 'xarray', 'obstore', 'prefect', 'dask'} & sys.modules.keys()))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
