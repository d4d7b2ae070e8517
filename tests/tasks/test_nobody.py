"""Clips without tracked people: every stage has an empty result."""

import shutil

import numpy as np
import pytest
import yaml

from flows.match import task_of
from flows.method import METHOD
from flows.registering import register
from flows.run_plan import plan_run
from worldpose.store.store import Store

NOBODY = {"tracking": {"size_range": [3.0, 4.0]}}
"""All detected people are too small, or too tall."""


@pytest.fixture
def empty(tiny, tmp_path):
    """A store and a match of two clips with named people, without any track."""
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.copy(folder / "reference" / "calibration.toml", folder)
    (folder / "detections" / "clip.npz").unlink(missing_ok=True)  # of a clip's own camera
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    (folder / "pitch.json").unlink()
    shutil.rmtree(folder / "annotations")
    spec["pitch"] = "none"  # on a pitch, feet would place every person
    spec["roster"] = [{"id": "ann"}]
    spec["clips"] = [
        {"id": "first", "frame_count": 6, "people": {0: "ann"}},
        {"id": "second", "first_frame": 6, "frame_count": 6, "people": {1: "ann"}},
    ]
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    store = Store.create(tmp_path / "project")
    return store, register(store, folder)[0]


def test_a_match_of_nobody_goes_through_two_iterations(empty):
    store, match = empty
    done = set()
    for iteration in (1, 2):
        units = plan_run(store, match, NOBODY, iteration=iteration)
        for stage in METHOD:
            for unit in units:
                if unit.recipe.stage == stage.name and unit.key not in done:
                    task_of(stage).fn(unit.work(store.url, match, f"{iteration:04}"))
                    done.add(unit.key)
        results = {
            unit.name: store.open_result(
                match.match_id, unit.recipe.stage, unit.recipe.unit, unit.key
            )
            for unit in units
        }
        assert results["refitting/first"]["joints"].shape == (6, 0, 17, 3)
        seen = results["filtering/first"]
        assert not seen["rejected"].values.any() and not seen["dropped"].values.any()
        assert (seen["fits"].values == -1).all()
        np.testing.assert_array_equal(seen["clock_late"].values, 0.0)
