"""Landmarks come out where the maps have them, with a stated error, and missing if not visible."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.body.keypoints import LANDMARKS
from worldpose.detection.bundled_nets import CELL, load_weights
from worldpose.detection.crops import CROP
from worldpose.detection.interfaces import People
from worldpose.detection.landmark_net import POINTS, LandmarkEstimator, LandmarkNet
from worldpose.detection.models import LANDMARK_WEIGHTS, load_landmarks
from worldpose.detection.net_inference import QuantizedNet
from worldpose.detection.pipeline import PeopleFinder
from worldpose.detection.settings import DetectionSettings
from worldpose.ingest.registration import digest_of_files

RECIPE = Path(__file__).parents[3] / "infra" / "embedded_detector"
ROWS, COLUMNS = CROP[1] // CELL, CROP[0] // CELL
HIDDEN, UNSURE = 3, 5
BOX = np.array([100.0, 60.0, 140.0, 160.0])
"""100 px tall: its crop shows 125 px in 128, 0.9765625 px per px of the crop."""


class PeakedNet(QuantizedNet):
    """Gives a map with one peak per point in column 10 + its number modulo 20, row 30."""

    def __init__(self):
        self.batches = []

    def __call__(self, images, surroundings=None):
        self.batches.append(surroundings)
        count = len(images)
        maps = torch.full((count, len(POINTS), ROWS, COLUMNS), -30.0)
        for point in range(len(POINTS)):
            maps[:, point, 30, 10 + point % 20] = 30.0
        doubt = torch.zeros(count, len(POINTS))
        doubt[:, UNSURE] = np.log(10.0)
        visible = torch.full((count, len(POINTS)), 3.0)
        visible[:, HIDDEN] = -3.0
        return maps, doubt, visible, torch.zeros(len(POINTS))


def people(*boxes):
    boxes = np.array(boxes).reshape(-1, 4)
    found = KeypointDetections.from_keypoints(
        np.zeros((len(boxes), 17, 2)), np.full((len(boxes), 17), 0.5)
    )
    return found.with_arrays(
        {**found.arrays(), "boxes": boxes, "score": np.full(len(boxes), 0.9)}, found.frame
    )


def test_points_are_in_frame_pixels_with_the_probability_of_being_correct():
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    (found,) = LandmarkEstimator(PeakedNet()).add_points([image], [people(BOX)])
    assert found.points == POINTS == (*LANDMARKS, *FEET)
    scale = 1.25 * 100.0 / 128.0
    crop = np.array([CELL * 10 + 0.5, CELL * 30 + 0.5])
    at = np.array([120.0, 110.0]) + scale * (crop - 0.5 * (np.array(CROP) - 1.0))
    assert_allclose(found.extra_keypoints[0, 0], at, atol=1e-3)
    # Correct: within 5 px; standard deviations of one pixel and of ten pixels of the crop.
    assert_allclose(
        found.extra_confidence[0, [0, UNSURE]],
        1.0 - np.exp(-0.5 * (5.0 / (scale * np.array([1.0, 10.0]))) ** 2),
        rtol=1e-6,
    )
    missing = np.isnan(found.extra_confidence[0])
    assert np.flatnonzero(missing).tolist() == [HIDDEN]
    assert_array_equal(np.isnan(found.extra_keypoints[0]).all(axis=-1), missing)
    assert_array_equal(found.keypoints, people(BOX).keypoints)


class Finder:
    view_size = None

    def detect(self, images):
        return [People(BOX[None], np.array([0.9])) for _ in images]

    def estimate(self, image, boxes):
        across = np.linspace(0.0, 1.0, 17)[:, None]
        joints = boxes[:, None, :2] + (boxes[:, 2:] - boxes[:, :2])[:, None] * across
        return KeypointDetections.from_keypoints(joints, np.full((len(boxes), 17), 0.8))


def test_detections_carry_landmarks_and_joints_stay_the_same_to_the_last_bit():
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    frames = [(7, image), (8, None), (9, image), (10, image)]
    chunks = []
    for landmarks in (None, LandmarkEstimator(PeakedNet())):
        finder = PeopleFinder([Finder()], Finder(), DetectionSettings(), landmarks=landmarks)
        chunks += list(finder.find(frames))
    plain, more = chunks
    assert not plain.points and more.points == POINTS
    for name, values in plain.arrays().items():
        assert_array_equal(more.arrays()[name], values)
    seen = np.isfinite(more.extra_confidence)
    assert seen[[0, 2, 3], 0].sum(axis=1).tolist() == [len(POINTS) - 1] * 3
    assert not seen[1].any() and not seen[:, 1:].any()


@pytest.fixture(scope="module")
def shot():
    """One rendered image of a stadium that no training had, with the truth of its landmarks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(RECIPE)
        scenes = importlib.import_module("scenes")
        labels = importlib.import_module("landmark_labels")
        (shot,) = scenes.render_scene(scenes.HELD_OUT, 39_001, views=1, frames=1)
        yield shot, labels.label_landmarks(shot)


def test_the_net_in_integers_was_made_from_the_shipped_weights():
    net = QuantizedNet(LANDMARK_WEIGHTS.with_suffix(".onnx"))
    assert net.weights_sha256 == digest_of_files(LANDMARK_WEIGHTS)


def test_the_shipped_net_finds_landmarks_of_unknown_people(shot):
    integers = True
    rendered, truth = shot
    device = (
        load_landmarks(DetectionSettings(landmarks=True))
        if integers
        else LandmarkEstimator(load_weights(LANDMARK_WEIGHTS, LandmarkNet()))
    )
    height = truth.boxes[:, 3] - truth.boxes[:, 1]
    kept = ~truth.ignored & (height > 34.0)
    assert kept.sum() >= 4
    (found,) = device.estimate([rendered.rendered.image], [truth.boxes])
    off = np.linalg.norm(found.places - truth.keypoints, axis=-1)
    shown = truth.visible[kept] == 2
    share = (off / height[:, None])[kept]
    assert np.median(share[shown]) < 0.03
    assert np.median(share[~shown]) < 0.06
    assert ((found.visible[kept] > 0.5) == shown).mean() > 0.8
    inside = off[kept] ** 2 < 5.99 * found.std[kept] ** 2
    assert 0.85 < inside[shown].mean() <= 1.0
