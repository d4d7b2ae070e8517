"""Why corrections of detections do not apply, from results with and without corrections."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from data_contracts.keypoints import KeypointDetections
from data_contracts.review import AddedDetection, DeletedDetection
from flows.review import detections, edit_conflicts
from worldpose.review.detections import replay_detections

FRAMES, PEOPLE = 10, 3
AT = {"camera": "c", "frame": 6, "detection": PEOPLE}
BOX = (1.0, 2.0, 3.0, 4.0)
SAID = [
    DeletedDetection(camera="c", frame=5, detection=0),
    DeletedDetection(camera="c", frame=5, detection=7),
    AddedDetection(camera="c", frame=40, detection=PEOPLE, box=BOX),
    AddedDetection(**AT, box=BOX),
    DeletedDetection(**AT),
]
WHY = {0: None, 1: "there is no detection 7 of c in frame 5", 2: "c has no frame 40"}
WHY |= {3: None, 4: None}


def stored(edits=()):
    """Detections of every person in every frame, with corrections."""
    many = (FRAMES, PEOPLE)
    shapes = {"keypoints": (17, 2), "confidence": (17,), "boxes": (4,), "score": ()}
    arrays = {name: np.ones((*many, *shape), np.float32) for name, shape in shapes.items()}
    found = KeypointDetections.from_arrays({**arrays, "frame": np.arange(FRAMES)})
    after = replay_detections(found, edits).observations
    dims = {"keypoints": ("joint", "xy"), "confidence": ("joint",), "boxes": ("side",)}
    kept = {n: (("frame", "person", *dims.get(n, ())), a) for n, a in after.arrays().items()}
    return xr.Dataset(kept, {"frame": after.frame})


class Recipe(SimpleNamespace):
    """A recipe of a result by its sources."""

    def model_copy(self, update):
        return Recipe(**update)


@pytest.fixture
def opened(monkeypatch):
    """Return a store whose latest run took in the first corrections."""

    def open_store(name, taken, *, has_plain=True):
        made = [each.model_dump(mode="json") for each in taken]
        record = SimpleNamespace(match_id="m", results={name: "own" if made else "plain"})
        manifest = SimpleNamespace(recipe=Recipe(sources={"edits": made} if made else {}))
        store = SimpleNamespace(
            run=lambda _: record,
            manifest=lambda *_: manifest,
            has=lambda *_: has_plain,
            open_result=lambda *place: stored(taken if place[-1] == "own" else ()),
        )
        monkeypatch.setattr(detections, "results_of", lambda *_: (name,))
        return store, record, made

    key = lambda recipe: "own" if recipe.sources.get("edits") else "plain"  # noqa: E731
    monkeypatch.setattr(edit_conflicts, "recipe_key", key)
    monkeypatch.setattr(detections, "edits_by_camera", lambda match: {"c": match.said})
    return open_store


@pytest.mark.parametrize("stage", ["ingest", "detection"])
@pytest.mark.parametrize("count", [0, 2, 4, 5])
def test_corrections_that_the_latest_run_lacks_are_replayed_alone(stage, count, opened):
    can = [n for n, edit in enumerate(SAID) if stage == "ingest" or edit.frame < FRAMES]
    store, *_ = opened(f"{stage}/c", [SAID[n] for n in can[:count]])
    match = SimpleNamespace(match_id="m", said=SAID)
    found = detections.replay_objections(store, match, "c")
    assert found == {n: WHY[n] for n in can[count:]}
    match.said = SAID + SAID[:1] * 51
    assert detections.replay_objections(store, match, "c") == {}  # too many


def test_of_older_results_each_correction_is_judged_if_that_is_possible(opened):
    store, record, made = opened("detection/c", SAID[:2])
    run = type("Run", (dict,), {"store": store, "record": record})({"detection/c": stored()})
    assert detections.objections_in(run, "detection/c", made) == (WHY[0], WHY[1])
    run.store, *_ = opened("detection/c", SAID[:2], has_plain=False)
    for why in detections.objections_in(run, "detection/c", made):
        assert "does not tell whether it applies" in why
    run["detection/c"].attrs["objections"] = ["no", None]
    assert detections.objections_in(run, "detection/c", made) == ["no", None]
