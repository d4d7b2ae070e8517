"""What bodies are fitted to: keypoints as they were triangulated, shapes as other clips said."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from data_contracts.conventions import COCO17
from tasks import body_fitting, refitting
from tasks.clip_inputs import ClipInputs

LEGS = [COCO17.index(f"{side}_{name}") for name in ("knee", "ankle") for side in ("left", "right")]


def stored(**arrays):
    """A result with these arrays, whose dimensions nobody asks for."""
    return {name: xr.DataArray(np.asarray(values)) for name, values in arrays.items()}


def test_legs_that_triangulation_exchanged_are_exchanged_for_bodies_too(monkeypatch):
    truth = np.random.default_rng(1).uniform(0.0, 1000.0, (4, 2, 3, 17, 2))
    index = np.array([[0, 2], [1, -1]])[None].repeat(4, axis=0)
    exchanged = np.zeros((4, 2, 2, 3), dtype=bool)
    exchanged[2, 0, 1, 2] = True  # the second person's legs, in the first camera
    seen = truth.copy()
    legs = [*LEGS, COCO17.index("left_hip"), COCO17.index("right_hip")]
    other = [joint + (1 if COCO17[joint].startswith("left") else -1) for joint in legs]
    seen[2, 0, 2, legs] = truth[2, 0, 2, other]
    results = {
        "retriangulation/clip": stored(
            person=[0, 1],
            joints=np.zeros((4, 2, 17, 3)),
            covariance=np.zeros((4, 2, 17, 3, 3)),
            exchanged=exchanged,
        ),
        "tracking/clip": stored(detection_index=index),
    }
    clip = ClipInputs(("a", "b"), None, None, np.arange(4), seen, None, 50.0)
    monkeypatch.setattr(body_fitting, "open_clip", lambda *_: clip)
    monkeypatch.setattr(body_fitting, "open_input", lambda store, work, name: results[name])
    people = body_fitting.open_people(None, SimpleNamespace(recipe=SimpleNamespace(unit="clip")))
    np.testing.assert_array_equal(people.keypoints, truth)


@pytest.mark.parametrize("weight", [0.25, 1.0, 4.0])
def test_clips_that_say_nothing_of_somebody_leave_him_anybody(monkeypatch, weight):
    silent = stored(person=[7], betas=np.zeros((1, 10)), betas_covariance=[np.eye(10) / weight])
    named = {"here": {"3": "ann"}, "second": {"7": "ann"}, "third": {"7": "ann"}}
    recipe = SimpleNamespace(unit="here", sources={"people": named})
    monkeypatch.setattr(refitting, "open_input", lambda *_: silent)
    known = refitting._known(None, SimpleNamespace(recipe=recipe), np.array([2, 3]), weight)
    assert list(known) == [1]
    np.testing.assert_allclose(known[1].covariance, np.eye(10) / weight)
