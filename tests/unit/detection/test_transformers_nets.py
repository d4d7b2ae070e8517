"""Checkpoints of transformers: saved folders are loaded offline, and boxes come back in pixels."""

import numpy as np
import pytest

from worldpose.detection.models import load_detectors, load_pose
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError

PICTURE = np.random.default_rng(0).integers(0, 255, (180, 240, 3), dtype=np.uint8)

pytestmark = pytest.mark.slow  # torch and transformers take ten seconds to come


def rt_detr_v2(transformers):
    backbone = transformers.RTDetrResNetConfig(
        embedding_size=16,
        hidden_sizes=[16, 24, 32, 48],
        depths=[1, 1, 1, 1],
        layer_type="basic",
        out_features=["stage2", "stage3", "stage4"],
    )
    config = transformers.RTDetrV2Config(
        backbone_config=backbone,
        encoder_in_channels=[24, 32, 48],
        encoder_hidden_dim=32,
        encoder_ffn_dim=32,
        d_model=32,
        num_queries=20,
        decoder_in_channels=[32, 32, 32],
        decoder_ffn_dim=32,
        decoder_layers=2,
        decoder_attention_heads=2,
        encoder_attention_heads=2,
        num_labels=2,
        id2label={0: "ball", 1: "person"},
        label2id={"ball": 0, "person": 1},
    )
    return transformers.RTDetrV2ForObjectDetection(config)


def test_a_saved_detector_finds_boxes_in_the_picture(tmp_path):
    transformers = pytest.importorskip("transformers")
    import torch

    torch.manual_seed(0)
    rt_detr_v2(transformers).eval().save_pretrained(tmp_path)
    transformers.RTDetrImageProcessorPil(
        size={"height": 96, "width": 128}, do_resize=True
    ).save_pretrained(tmp_path)
    settings = DetectionSettings(detector=f"transformers:{tmp_path}")
    (detector,) = load_detectors(settings)
    assert detector.view_size == (128, 96)
    (people,) = detector.detect([PICTURE])
    (again, other) = detector.detect([PICTURE, PICTURE[::-1].copy()])
    assert people.boxes.shape == (len(people.scores), 4)
    assert len(people.scores) > 0  # random weights are half sure of everything
    assert np.array_equal(people.boxes, again.boxes)  # whoever else is in the batch
    assert not np.array_equal(people.boxes, other.boxes)
    assert (people.scores >= 0.05).all() and (people.scores <= 1.0).all()
    middle = (people.boxes[:, :2] + people.boxes[:, 2:]) / 2.0
    assert (middle > -1.0).all() and (middle < [240.0, 180.0]).all()


def test_a_saved_vitpose_gives_points_around_each_box(tmp_path):
    transformers = pytest.importorskip("transformers")
    import torch

    torch.manual_seed(0)
    backbone = transformers.VitPoseBackboneConfig(
        image_size=[64, 48],
        patch_size=[16, 16],
        hidden_size=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        out_indices=[2],
        out_features=["stage2"],
    )
    config = transformers.VitPoseConfig(
        backbone_config=backbone, num_labels=17, use_simple_decoder=True
    )
    transformers.VitPoseForPoseEstimation(config).eval().save_pretrained(tmp_path)
    transformers.VitPoseImageProcessorPil(size={"height": 64, "width": 48}).save_pretrained(
        tmp_path
    )
    estimator = load_pose(DetectionSettings(pose=f"transformers:{tmp_path}"))
    boxes = np.array([[40.0, 30.0, 70.0, 110.0], [150.0, 60.0, 180.0, 140.0]])
    poses = estimator.estimate(PICTURE, boxes)
    alone = estimator.estimate(PICTURE, boxes[1:])
    assert poses.keypoints.shape == (2, 17, 2)
    np.testing.assert_array_equal(poses.keypoints[1], alone.keypoints[0])
    for box, points in zip(boxes, poses.keypoints, strict=True):
        found = points[np.isfinite(points).all(axis=1)]
        # A crop is a quarter larger than its box, and as wide as its shape asks.
        assert (np.abs(found - (box[:2] + box[2:]) / 2.0) < [60.0, 70.0]).all()
    assert estimator.estimate(PICTURE, np.empty((0, 4))).keypoints.shape == (0, 17, 2)


def test_pickled_weights_and_foreign_folders_are_refused(tmp_path):
    transformers = pytest.importorskip("transformers")
    folder = tmp_path / "pickled"
    net = rt_detr_v2(transformers)
    net.save_pretrained(folder)
    transformers.RTDetrImageProcessorPil().save_pretrained(folder)
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(InputError, match=r"model\.safetensors"):
        load_detectors(DetectionSettings(detector=f"transformers:{folder}"))
    with pytest.raises(InputError, match=r"config\.json"):
        load_detectors(DetectionSettings(detector=f"transformers:{tmp_path}"))
