"""Nets in integers and in floating point, on a CPU and, where there is one, on a GPU."""

import copy
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest
import torch

from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, Seen, load_weights
from worldpose.detection.bundled_pose import BundledPoseEstimator
from worldpose.detection.crops import CROP
from worldpose.detection.models import BUNDLED_WEIGHTS
from worldpose.detection.net_inference import CROPS, PlacedNet, QuantizedNet
from worldpose.detection.pipeline import detect_people
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError
from worldpose.geometry.boxes import box_iou
from worldpose.simulation.matches import MatchOptions, simulate_match
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.training.labels import read_picture

on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@pytest.fixture(scope="module")
def crops():
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (3 * CROPS, 3, CROP[1], CROP[0]), dtype=np.uint8)
    maps = rng.random((3 * CROPS, 3, 32, 24)).astype(np.float32)
    return torch.from_numpy(images), torch.from_numpy(maps)


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    folder = tmp_path_factory.mktemp("still") / "tiny"
    options = MatchOptions(duration=0.04, cameras=2, video=False)
    simulate_match(SCENARIOS["tiny"], 5, folder, options)
    return read_picture(sorted((folder / "stills").iterdir())[0])


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
