"""Clips without tracked people: every stage has an empty result."""

import json
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


def test_a_run_says_what_it_changed_in_the_2d_poses_of_a_camera(tiny, tmp_path):
    folder = shutil.copytree(tiny, tmp_path / "match")
    shutil.rmtree(folder / "reference")
    file = sorted((folder / "detections").glob("cam*.npz"))[0]
    file.unlink()
    triples = [[100.0 + 9 * joint, 300.0, 1.2 if joint < 3 else 0.9] for joint in range(17)]
    points = [number for triple in triples for number in triple]
    people = [{"image_id": 0, "keypoints": given} for given in (points, [float("nan")] * 51)]
    file.with_suffix(".json").write_text(json.dumps(people))
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)
    unit = next(u for u in plan_run(store, match, {}) if u.name == f"ingest/{file.stem}")
    task_of(METHOD[0]).fn(unit.work(store.url, match, "0001"))
    assert store.manifest(match.match_id, "ingest", file.stem, unit.key).warnings == (
        f"confidences above 1, which count as 1: 3 ({file.stem})",
        f"entries without a known joint, which count as no person: 1 ({file.stem})",
    )
