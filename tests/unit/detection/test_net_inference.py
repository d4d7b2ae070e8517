"""Nets in integers and in batches, on processors and GPUs; and the net of landmarks."""

import copy
import importlib
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.body.keypoints import LANDMARKS
from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import CELL, KeypointNet, PeopleNet, Seen, load_weights
from worldpose.detection.bundled_pose import BundledPoseEstimator
from worldpose.detection.crops import CROP
from worldpose.detection.interfaces import People
from worldpose.detection.landmark_net import POINTS, LandmarkEstimator
from worldpose.detection.models import BUNDLED_WEIGHTS, load_landmarks
from worldpose.detection.net_inference import CROPS, PlacedNet, QuantizedNet
from worldpose.detection.pipeline import PeopleFinder, detect_people
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_iou

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.fixture(scope="module")
def crops():
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (3 * CROPS, CROP[1], CROP[0], 3), dtype=np.uint8)
    maps = rng.random((3 * CROPS, 3, 32, 24)).astype(np.float32)
    return images, maps


@pytest.mark.parametrize("count", [5, CROPS])
def test_integers_give_equal_bytes_in_every_batch(crops, count):
    net = QuantizedNet(BUNDLED_WEIGHTS[1].with_suffix(".onnx"))
    some, whole = (Seen._make(net(crops[0][:n], crops[1][:n])) for n in (count, CROPS))
    for name in ("maps", "doubt", "boxes", "fit"):
        np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[:count])


def test_torch_alone_finds_the_same_people_as_opencv(still):
    nets = PeopleNet(), KeypointNet()
    people, joints = (load_weights(*each) for each in zip(BUNDLED_WEIGHTS, nets, strict=True))
    boxes, poses = np.empty((0, 4)), []
    # torch samples on every device but "cpu", so on this other name of it.
    for device in ("cpu", "cpu:0"):
        (seen,) = BundledDetector(copy.deepcopy(people), device).detect([still])
        sure = seen.boxes[seen.scores >= 0.4]
        boxes = boxes if len(boxes) else sure
        assert len(boxes) == len(sure) >= 4 and box_iou(boxes, sure).max(axis=1).min() > 0.98
        pose = BundledPoseEstimator(copy.deepcopy(joints), device)
        for zoom in (1, 3):  # crops smaller than the net's, and much larger ones
            enlarged = cv2.resize(still, None, fx=zoom, fy=zoom)
            poses.append(pose.estimate(enlarged, zoom * boxes))
    for before, after, zoom in zip(poses[:2], poses[2:], (1, 3), strict=True):
        known = before.confidence > 0.5
        apart = np.linalg.norm(before.keypoints - after.keypoints, axis=-1)[known]
        assert known.sum() > 30 and np.quantile(apart, 0.95) < 0.1 * zoom


class Small(torch.nn.Module):
    """Has memory for three images."""

    def forward(self, images):
        if len(images) > 3:
            raise torch.OutOfMemoryError
        return (images.mean(dim=(1, 2, 3)),)


def test_a_batch_that_exceeds_the_memory_is_halved_and_said(crops):
    net = PlacedNet(Small(), "cpu", False, fill=CROPS)
    with pytest.warns(RuntimeWarning, match="memory is too small"):
        (found,) = net(crops[0])
    (each,) = PlacedNet(Small(), "cpu", False)(crops[0])
    torch.testing.assert_close(found, each)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_one_clear_error(still):
    with pytest.raises(InputError, match=r"detection\.device") as caught:
        detect_people([still], DetectionSettings(device="cuda"))
    assert "detection.device=cpu" in str(caught.value)


@on_gpu
def test_a_gpu_finds_the_same_people_as_a_cpu_and_in_two_threads(still):
    weights = [f"embedded:{Path(each)}" for each in BUNDLED_WEIGHTS]
    on_cpu = detect_people([still] * 4, DetectionSettings(detector=weights[0], pose=weights[1]))
    settings = DetectionSettings(device="cuda")
    found: list = [None, None]

    def find(number):
        found[number] = detect_people([still] * 4, settings)

    threads = [Thread(target=find, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_array_equal(found[0].keypoints, found[1].keypoints)
    assert found[0].score.shape == on_cpu.score.shape
    np.testing.assert_allclose(found[0].boxes, on_cpu.boxes, atol=0.1)
    apart = np.linalg.norm(found[0].keypoints - on_cpu.keypoints, axis=-1)
    assert np.nanmedian(apart) < 0.02


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


def test_the_shipped_net_finds_landmarks_of_unknown_people(shot):
    rendered, truth = shot
    device = load_landmarks(DetectionSettings(landmarks=True))
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
