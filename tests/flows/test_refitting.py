"""Bodies fitted again: which clips, from what, and one shape for who is known in several clips."""

import shutil

import numpy as np
import pytest
import yaml

from flows.match import task_of
from flows.method import METHOD
from flows.registering import open_match, register
from flows.run_plan import plan_run
from flows.stages.body_fitting import REFITTING
from worldpose.errors import InputError
from worldpose.store.store import Store


def halves(tiny, folder, **people):
    """The match `tiny` with given cameras and two clips, in which people are named."""
    if not folder.exists():
        shutil.copytree(tiny, folder)
        shutil.copy(folder / "reference" / "calibration.toml", folder)
    spec = yaml.safe_load((folder / "match.yaml").read_text())
    spec["match_id"] = "halves"
    spec["roster"] = [{"id": name} for name in ("ann", "bea", "cleo")]
    spec["clips"] = [
        {"id": "first", "frame_count": 15},
        {"id": "second", "first_frame": 15, "frame_count": 15},
    ]
    for clip in spec["clips"]:
        clip["people"] = people.get(clip["id"], {})
    (folder / "match.yaml").write_text(yaml.safe_dump(spec))
    (folder / "detections" / "clip.npz").unlink(missing_ok=True)
    return folder


def test_a_match_without_calibrated_broadcast_or_names_has_nothing_to_refit(tiny, tmp_path):
    store = Store.create(tmp_path / "project")
    match, _ = register(store, tiny)
    assert REFITTING.units(match) == ()
    named = halves(tiny, tmp_path / "match", first={0: "ann"}, second={1: "bea"})
    assert REFITTING.units(register(store, named)[0]) == ()


def test_clips_with_the_same_person_are_fitted_again_with_each_others_shapes(tiny, tmp_path):
    folder = halves(tiny, tmp_path / "match", first={0: "ann", 2: "bea"}, second={1: "ann"})
    match, _ = register(Store.create(tmp_path / "project"), folder)
    assert REFITTING.units(match) == ("first", "second")
    assert "body_fitting/second" in REFITTING.inputs(match, "first")
    assert REFITTING.sources(match, "first")["people"] == {
        "first": {"0": "ann"},  # a name that no other clip has changes no shape
        "second": {"1": "ann"},
    }
    # Only namesakes of the clip itself matter: another name there makes nothing stale.
    assert REFITTING.sources(match, "second")["people"]["first"] == {"0": "ann"}


def test_names_beyond_the_roster_are_refused(tiny, tmp_path):
    folder = halves(tiny, tmp_path / "match", first={0: "nobody"})
    with pytest.raises(InputError, match="nobody"):
        register(Store.create(tmp_path / "project"), folder)


@pytest.mark.slow
def test_shapes_of_a_named_person_are_pooled_over_clips(tiny, tmp_path):
    folder = halves(tiny, tmp_path / "match")
    store = Store.create(tmp_path / "project")
    match, _ = register(store, folder)

    def compute():
        opened = open_match(store, match.match_id)
        for stage in METHOD:
            for unit in plan_run(store, opened, {}):
                if unit.recipe.stage == stage.name and not unit.published:
                    task_of(stage).fn(unit.work(store.url, opened, "0001"))
        return {
            unit.name: store.open_result(
                match.match_id, unit.recipe.stage, unit.recipe.unit, unit.key
            )
            for unit in plan_run(store, opened, {})
        }

    results = compute()
    before, after = (results[f"body_fitting/{clip}"] for clip in ("first", "second"))
    away = np.linalg.norm(
        before["joints"].values[-1, :, None, 5:] - after["joints"].values[0, None, :, 5:], axis=-1
    ).mean(axis=-1)
    one, two = np.unravel_index(int(np.nanargmin(away)), away.shape)
    named = [int(before["person"].values[one]), int(after["person"].values[two])]
    halves(tiny, folder, first={named[0]: "ann"}, second={named[1]: "ann"})
    again = compute()["refitting/first"]
    np.testing.assert_array_equal(np.flatnonzero(again["pooled"].values), [one])
    own, pooled = (np.trace(x["betas_covariance"].values[one]) for x in (before, again))
    # Another clip as long, with the detector's offsets in common.
    assert 0.3 * own < pooled < 0.95 * own
