import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People

RECIPE = Path(__file__).parents[3] / "infra" / "embedded_detector"


class KilledError(Exception):
    pass


@pytest.mark.slow
def test_the_shipped_recipe_goes_on_where_it_was_killed_and_ends_with_the_same_weights(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(RECIPE)
    recipe = importlib.import_module("train")
    # One scene of each set; two steps of each phase, or a few.
    share, undisturbed, killed = 5e-4, tmp_path / "undisturbed", tmp_path / "killed"
    recipe.main(undisturbed, ["scenes", "people", "keypoints", "figures"], share, {})
    figures = json.loads((undisturbed / "figures.json").read_text())
    assert figures["pictures"] == 8 and 0 < figures["keypoints"]["all"]["pck"] < 1

    killed.mkdir()
    for name in recipe.SCENES:
        (killed / name).symlink_to(undisturbed / name)
    said, deaths = [], []

    def mortal(line):
        said.append(line)
        if line.startswith("step 2 of 2") and len(deaths) < len(parts):
            deaths.append(line)
            raise KilledError

    monkeypatch.setattr(recipe, "say", mortal)
    parts = []
    for part in ("people", "keypoints"):
        parts.append(part)
        # It dies in the second phase, after its first checkpoint.
        with pytest.raises(KilledError):
            recipe.main(killed, [part], share, {})
        assert not (killed / f"embedded_{part}.safetensors").exists()
        recipe.main(killed, [part], share, {})
        name = f"embedded_{part}.safetensors"
        assert (killed / name).read_bytes() == (undisturbed / name).read_bytes()
    assert said.count("resumes after step 1") == 2


@pytest.mark.slow
def test_the_recipe_of_landmarks_gives_weights_that_state_their_errors(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE)
    recipe = importlib.import_module("landmarks")
    scenes = {name: (kind, count, 1, 1) for name, (kind, count, _, _) in recipe.SCENES.items()}
    monkeypatch.setattr(recipe, "SCENES", scenes)
    said = []
    monkeypatch.setattr(recipe, "say", said.append)
    recipe.main(tmp_path, ["scenes", "train", "score"], 1e-3)
    first = (tmp_path / "embedded_landmarks.safetensors").read_bytes()
    scores = json.loads((tmp_path / "landmark_scores.json").read_text())
    assert scores["in_95_visible"] > 0.6  # of other images than those that it was scaled on
    assert any(line.startswith("standard deviations times") for line in said)
    # Phases that are done are read, with the same result.
    before = len(said)
    recipe.main(tmp_path, ["train"], 1e-3)
    assert (tmp_path / "embedded_landmarks.safetensors").read_bytes() == first
    assert not any("loss" in line for line in said[before:])
    flip = recipe.FLIP
    assert [flip[other] for other in flip] == list(range(len(flip)))
    assert all(other != point for point, other in enumerate(flip))


def people(boxes, scores):
    return People(np.array(boxes, dtype=np.float64).reshape(-1, 4), np.array(scores))


@pytest.fixture
def real_frames(monkeypatch):
    monkeypatch.syspath_prepend(RECIPE)
    return importlib.import_module("real_frames")


def test_people_that_both_nets_see_are_labelled_and_others_are_in_doubt(real_frames):
    agreed, missed, faint = [0, 0, 10, 20], [90, 0, 99, 20], [50, 50, 60, 70]
    yolox = [people([agreed, missed], [0.5, 0.6]), people([faint], [0.2])]
    bundled = people([[1, 0, 11, 20], [200, 0, 210, 20]], [0.9, 0.9])
    boxes, doubtful = real_frames.agree_on_people(yolox, bundled)
    np.testing.assert_allclose(boxes, [[0.5, 0.0, 10.5, 20.0]])
    # A detection of the bundled net alone is background.
    np.testing.assert_allclose(sorted(doubtful.tolist()), [faint, missed])
    boxes, doubtful = real_frames.agree_on_people([people([], [])], people([], []))
    assert len(boxes) == len(doubtful) == 0


class SlippingPose:
    """Finds all joints in one place, the nose at the corner of the box, no left ear."""

    def estimate(self, image, boxes):
        middle = np.tile(np.array([60.0, 50.0]), (len(boxes), 17, 1))
        if image[0, 0, 0]:  # the mirrored image
            middle[..., 0] = image.shape[1] - 1 - 60.0
        middle[:, 0] = boxes[:, :2]
        confidence = np.full((len(boxes), 17), 0.9)
        confidence[:, 4 if image[0, 0, 0] else 3] = 0.1
        return KeypointDetections(middle, confidence, boxes, np.ones(len(boxes)))


def test_joints_are_labelled_where_three_views_agree(real_frames):
    image = np.zeros((120, 200, 3), dtype=np.uint8)
    image[0, -1] = 255
    boxes = np.array([[40.0, 10.0, 80.0, 90.0], [40.0, 10.0, 60.0, 49.0]])
    keypoints, visible = real_frames.agree_on_joints(SlippingPose(), image, boxes)
    assert list(np.flatnonzero(visible[0] == 0)) == [0, 3]
    np.testing.assert_allclose(keypoints[0, 1], [60.0, 50.0])
    assert np.isnan(keypoints[0, 0]).all()
    assert not visible[1].any()  # 39 px: too small
