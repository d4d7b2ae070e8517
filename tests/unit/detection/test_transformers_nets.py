"""Checkpoints of transformers: saved folders are loaded offline, and boxes come back in pixels."""

import numpy as np
import pytest

from worldpose.detection.models import load_detectors, load_pose
from worldpose.detection.settings import DetectionSettings
from worldpose.errors import InputError

PICTURE = np.random.default_rng(0).integers(0, 255, (180, 240, 3), dtype=np.uint8)

pytestmark = pytest.mark.slow  # torch and transformers take ten seconds to come


def rt_detr_v2(transformers, names=("ball", "person")):
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
        num_labels=len(names),
        id2label=dict(enumerate(names)),
        label2id={name: number for number, name in enumerate(names)},
    )
    return transformers.RTDetrV2ForObjectDetection(config)


def save_detector(transformers, folder, *names, **size):
    rt_detr_v2(transformers, *names).eval().save_pretrained(folder)
    transformers.RTDetrImageProcessorPil(**size).save_pretrained(folder)


def test_a_saved_detector_finds_boxes_in_the_picture(tmp_path):
    transformers = pytest.importorskip("transformers")
    import torch

    torch.manual_seed(0)
    save_detector(transformers, tmp_path, size={"height": 96, "width": 128}, do_resize=True)
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


def save_vitpose(transformers, folder, count=17):
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
        backbone_config=backbone, num_labels=count, use_simple_decoder=True
    )
    transformers.VitPoseForPoseEstimation(config).eval().save_pretrained(folder)
    transformers.VitPoseImageProcessorPil(size={"height": 64, "width": 48}).save_pretrained(folder)


def test_a_saved_vitpose_gives_points_around_each_box(tmp_path):
    transformers = pytest.importorskip("transformers")
    import torch

    torch.manual_seed(0)
    save_vitpose(transformers, tmp_path)
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
    save_vitpose(transformers, tmp_path, 133)
    with pytest.raises(InputError, match="found 133 keypoints"):
        load_pose(DetectionSettings(pose=f"transformers:{tmp_path}"))


def test_pickled_weights_and_foreign_folders_are_refused(tmp_path):
    transformers = pytest.importorskip("transformers")
    folder = tmp_path / "pickled"
    save_detector(transformers, folder)
    (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
    with pytest.raises(InputError, match=r"model\.safetensors"):
        load_detectors(DetectionSettings(detector=f"transformers:{folder}"))
    with pytest.raises(InputError, match=r"config\.json"):
        load_detectors(DetectionSettings(detector=f"transformers:{tmp_path}"))


def test_classes_of_people_follow_the_rule_of_onnx_detectors(tmp_path):
    transformers = pytest.importorskip("transformers")
    unnamed = tuple(f"LABEL_{number}" for number in range(80))
    football = ("ball", "goalkeeper", "player", "referee")
    for names, asked, expected in (
        (football, None, (1, 2, 3)),
        (football, [0], (1, 2, 3)),  # asked of another net of an ensemble
        (unnamed, [2], (2,)),
        (unnamed, None, (0,)),
        (unnamed[:4], None, None),
    ):
        folder = tmp_path / f"{len(names)}{asked}{expected}"
        save_detector(transformers, folder, names)
        settings = DetectionSettings(detector=f"transformers:{folder}", person_classes=asked)
        if expected is None:
            with pytest.raises(InputError, match="4 classes without names"):
                load_detectors(settings)
        else:
            assert load_detectors(settings)[0]._people == expected


def test_weights_that_are_cut_or_lack_the_head_are_refused(tmp_path):
    transformers = pytest.importorskip("transformers")
    from safetensors.torch import load, save_file

    save_detector(transformers, tmp_path)
    file, settings = tmp_path / "model.safetensors", f"transformers:{tmp_path}"
    content, weights = file.read_bytes(), load(file.read_bytes())
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"model\.safetensors"):
        load_detectors(DetectionSettings(detector=settings))
    headless = {name: each for name, each in weights.items() if "class_embed" not in name}
    save_file(headless, file, metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"none of .* parameters.*class_embed"):
        load_detectors(DetectionSettings(detector=settings))
