"""Outputs of nets in pixels of the image: every known form, with hand-made numbers."""

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest

from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.detection import onnx_nets
from worldpose.detection.crops import crops_around, cut_crop, frame_from_crop
from worldpose.detection.models import digest_of_weights, load_detectors, weights_of
from worldpose.detection.onnx_nets import OnnxNet, _OnnxPose
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.views import FlipTest
from worldpose.errors import InputError


def test_a_crop_shows_the_box_and_its_points_come_back():
    picture = np.zeros((400, 600, 3), dtype=np.uint8)
    rng = np.random.default_rng(2)
    for size in (20, 90, 300):  # enlarged, reduced a little and much
        x, y = rng.uniform([200, 180], [260, 200])
        column, row = int(x + 0.5 * size * 0.4), int(y)
        picture[:] = 0
        picture[row - 6 : row + 7, column - 6 : column + 7] = 255  # a square around the point
        box = np.array([[x - size * 0.2, y - size / 2, x + size * 0.2, y + size / 2]])
        mapping = frame_from_crop(crops_around(box, (48, 64))[0], (48, 64))
        crop = cut_crop(picture, mapping, (48, 64), 0)[..., 0].astype(float)
        middle = np.array(
            [
                np.average(np.arange(48), weights=crop.sum(0)),
                np.average(np.arange(64), weights=crop.sum(1)),
            ]
        )
        back = mapping[:, :2] @ middle + mapping[:, 2]
        if crop[0].any() or crop[-1].any() or crop[:, 0].any() or crop[:, -1].any():
            continue  # the square reaches over the crop: its middle is another
        # A fifth of a crop's pixel: the square's hard edges are sampled twice.
        np.testing.assert_allclose(back, [column, row], atol=0.2 * max(1.0, mapping[0, 0]))


class Leaning:
    """Sees joint j at column 10 j of the box, `late` px too far right; no wrists to the left."""

    def estimate(self, picture, boxes):
        columns = np.where(
            picture[0, 0, 0] == 1, 10.0 * np.arange(17), 10.0 * np.array(COCO17_FLIP)
        )
        sign = 1.0 if picture[0, 0, 0] == 1 else -1.0  # the first column is marked
        start = boxes[:, 0] if sign > 0 else boxes[:, 2]
        x = start[:, None] + sign * columns + 2.0
        confidence = np.full(x.shape, 0.8 if sign > 0 else 0.4)
        confidence[:, 9] = np.nan
        keypoints = np.stack([x, np.repeat(boxes[:, 1:2], 17, axis=1)], axis=2)
        keypoints[:, 9] = np.nan
        return KeypointDetections.from_keypoints(keypoints, confidence)


def test_what_leans_to_one_side_is_set_right_by_the_mirror():
    picture = np.zeros((50, 300, 3), dtype=np.uint8)
    picture[0, 0] = 1
    boxes = np.array([[20.0, 5.0, 100.0, 45.0]])
    poses = FlipTest(Leaning()).estimate(picture, boxes)
    expected = 20.0 + 10.0 * np.arange(17) + (0.8 * 2.0 - 0.4 * 2.0) / 1.2
    expected[9] = 20.0 + 90.0 - 2.0  # seen in the mirror alone, and the other in the image
    expected[10] = 20.0 + 100.0 + 2.0
    np.testing.assert_allclose(poses.keypoints[0, :, 0], expected)
    np.testing.assert_allclose(poses.keypoints[0, :, 1], 5.0)
    assert poses.confidence[0, [0, 9, 10]].tolist() == pytest.approx([0.6, 0.4, 0.8])


@pytest.mark.parametrize(
    "name", [{"detector": "yolo"}, {"detector": "onnx:"}, {"pose": "onnx-rtmpose:FILE"}]
)
def test_an_unknown_name_of_a_net_is_refused(name):
    with pytest.raises(InputError, match="onnx:FILE"):
        weights_of(DetectionSettings(**name))


def test_external_data_of_a_net_is_part_of_its_digest(tmp_path):
    net, data = tmp_path / "model.onnx", tmp_path / "model.onnx.data"
    net.write_bytes(b"net")
    alone = digest_of_weights(net)
    data.write_bytes(b"other")
    assert digest_of_weights(net) == alone == hashlib.sha256(b"net").hexdigest()
    net.write_bytes(b"\x6a\x1b\n\x08location\x12\x0fmodel.onnx.data")
    before = digest_of_weights(net)
    data.write_bytes(b"weights")
    assert digest_of_weights(net) != before


def test_a_net_that_takes_bytes_gets_grey_levels():
    given = []

    def run(crops):
        given.append(crops)
        return [np.ones((len(crops), 17, 4, 4))]

    net = SimpleNamespace(size=(6, 8), dtype=np.dtype(np.uint8), run=run)
    _OnnxPose(net, normal=True).estimate(
        np.full((50, 50, 3), 130, np.uint8), np.array([[10.0, 10.0, 30.0, 40.0]])
    )
    np.testing.assert_array_equal(given[0], 130)


@pytest.mark.parametrize(
    ("shape", "kind"), [([8, 3, 64, 64], "tensor(float)"), ([1, 3, 64, 64], "tensor(double)")]
)
def test_a_net_with_another_batch_or_type_is_refused(monkeypatch, shape, kind):
    taken = [SimpleNamespace(name="x", shape=shape, type=kind)]
    session = SimpleNamespace(get_inputs=lambda: taken)
    monkeypatch.setattr(onnx_nets, "open_session", lambda *_: session)
    with pytest.raises(InputError, match="batch 1 and float32"):
        OnnxNet("net.onnx", "cpu", (64, 64))


def test_a_file_that_is_no_net_is_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    file = tmp_path / "net.onnx"
    file.write_bytes(b"none")
    with pytest.raises(InputError, match="ONNX file"):
        load_detectors(DetectionSettings(detector=f"onnx:{file}"))
    with pytest.raises(InputError, match="nothing"):
        weights_of(DetectionSettings(detector=f"onnx:{tmp_path / 'other.onnx'}"))
