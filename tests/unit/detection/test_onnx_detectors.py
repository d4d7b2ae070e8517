"""Nets of others: forms of ONNX outputs, and crops for pose nets."""

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest

from data_contracts.conventions import COCO17_FLIP
from data_contracts.keypoints import KeypointDetections
from worldpose.detection import onnx_nets
from worldpose.detection.crops import crops_around, cut_crop, frame_from_crop
from worldpose.detection.models import digest_of_weights, load_detectors, weights_of
from worldpose.detection.onnx_detectors import (
    FORMS,
    _class_names,
    find_person_classes,
    recognize_form,
)
from worldpose.detection.onnx_nets import OnnxNet, _OnnxPose
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.views import FlipTest
from worldpose.errors import InputError

SIZE = (96, 64)
"""Of the view [px]: grids of 12 x 8, 6 x 4 and 3 x 2 cells."""
CELLS = 12 * 8 + 6 * 4 + 3 * 2
# A box whose outer edges are 10, 20, 30 and 60: pixels 10 to 29 and 20 to 59.
BOX = [9.5, 19.5, 29.5, 59.5]
PERSON = [20.0, 40.0, 20.0, 40.0]
"""Its centre and size."""
CAR = [70.0, 30.0, 20.0, 20.0]


def grid(rows, objectness, *, classes=80):
    """Pixels of a decoded grid: empty cells around their own places, a person and a car."""
    found = np.zeros((rows, 4 + objectness + classes))
    found[:, :2] = np.random.default_rng(0).uniform([0, 0], SIZE, (rows, 2))
    found[:, 2:4] = 8.0
    found[5, :4], found[9, :4] = PERSON, CAR
    if objectness:
        found[:, 4] = 0.001
        found[[5, 9], 4] = 0.9
    found[5, 4 + objectness], found[9, -1] = 0.8, 0.9
    return found


def raw_yolox():
    """The same as offsets in cells and logarithms of sizes."""
    found = np.zeros((CELLS, 85))
    found[:, 4] = 0.001
    # Cell (2, 5) of the finest grid, stride 8, begins at 16, 40.
    found[5 * 12 + 2] = [0.5, 0.0, np.log(20 / 8), np.log(40 / 8), 0.9, 0.8, *[0.0] * 79]
    # Cell (2, 0) of the coarsest grid, stride 32: a car.
    found[-4] = [6 / 32, 30 / 32, np.log(20 / 32), np.log(20 / 32), 0.9, *[0.0] * 79, 0.9]
    return found


def detr(classes, person, score):
    """Queries of a DETR: logits, and boxes in shares of the image."""
    logits, boxes = np.full((30, classes), -9.0), np.full((30, 4), 0.5)
    logits[3, person], logits[4, 7] = score, score
    boxes[3], boxes[4] = np.array(PERSON) / [*SIZE, *SIZE], np.array(CAR) / [*SIZE, *SIZE]
    return [logits, boxes]


DECODED, YOLOV6, NO_OBJECT = grid(CELLS, 1), grid(CELLS, 1), detr(92, 1, 4.0)
ROWS, COLUMNS = np.mgrid[:8, :12]
DECODED[: 12 * 8, :2] = np.stack([COLUMNS, ROWS], -1).reshape(-1, 2) * 8.0 + 4.0
DECODED[5, :4], DECODED[9, :4] = PERSON, CAR
YOLOV6[:, 4] = 1.0
NO_OBJECT[0][:, -1] = 0.0
LOGIT = np.log(0.7 / 0.3)
MOVENET = np.zeros((6, 56))
MOVENET[0, 51:] = [20 / 64, 10 / 96, 60 / 64, 30 / 96, 0.7]
DETS = np.array([[10, 20, 30, 60, 0.7], [60, 20, 80, 40, 0.9]])
NMS = np.insert(DETS, 5, [0, 2], axis=1)
LABELS, SCORES = np.array([0, 2]), np.array([0.7, 0.9])
OUTPUTS = {
    "yolox": ([raw_yolox()], 0.72),
    "yolox-decoded": ([DECODED], 0.72),
    "yolov5": ([grid(3 * CELLS, 1)], 0.72),
    "yolov6": ([YOLOV6], 0.8),
    "yolov8": ([grid(CELLS, 0).T], 0.8),
    "yolo-nms": ([NMS], 0.7),
    "detr": (NO_OBJECT, np.exp(4.0) / (np.exp(4.0) + 1.0 + 90 * np.exp(-9.0))),
    "rfdetr": (detr(91, 1, LOGIT), 0.7),
    "rtdetr": (detr(80, 0, LOGIT), 0.7),
    "rtdetr-boxes": ([LABELS, DETS[:, :4], SCORES], 0.7),
    "movenet": ([MOVENET], 0.7),
}


@pytest.mark.parametrize("form", OUTPUTS)
def test_a_form_is_recognized_and_its_person_decoded(form):
    outputs, score = OUTPUTS[form]
    assert recognize_form("net.onnx", outputs, SIZE) == form
    count = FORMS[form].classes and FORMS[form].classes(outputs)
    people = find_person_classes("net.onnx", count, {}, None)
    found = FORMS[form].decode(outputs, SIZE, people)
    np.testing.assert_allclose(found.boxes, [BOX], atol=1e-9)
    np.testing.assert_allclose(found.scores, [score])


@pytest.mark.parametrize("form", ["rtmdet", "yolox-dets"])
def test_outputs_of_two_families_are_refused_until_one_is_named(form):
    with pytest.raises(InputError, match=f"{form}: ") as refused:
        recognize_form("net.onnx", [DETS, LABELS], SIZE)
    assert "detection.detector=onnx-rtmdet:FILE" in str(refused.value)
    np.testing.assert_allclose(FORMS[form].decode([DETS, LABELS], SIZE, (0,)).boxes, [BOX])


@pytest.mark.parametrize(
    "outputs", [[], [np.zeros((3, 7))], [np.zeros((CELLS, 84))], [np.zeros((10, 4))] * 3]
)
def test_unknown_outputs_are_refused_with_all_forms(outputs):
    with pytest.raises(InputError, match=r"yolox: .*rtmdet: .*96 x 64|96 x 64.*yolox: .*rtmdet: "):
        recognize_form("net.onnx", outputs, SIZE)


def test_classes_of_people_are_named_numbered_or_asked_for():
    football = {0: "ball", 1: "goalkeeper", 2: "player", 3: "Referee"}

    def classes(names, asked=None):
        return find_person_classes("net.onnx", 4, names, asked)

    assert (classes(football), classes(football, [2])) == ((1, 2, 3), (2,))
    assert classes({}, [1, 2]) == (1, 2)
    with pytest.raises(InputError, match="4 classes without names"):
        classes({})
    with pytest.raises(InputError, match="0 ball, 1 goal"):
        classes({0: "ball", 1: "goal"})
    with pytest.raises(InputError, match="below 4"):
        classes({}, [4])
    assert classes({0: "ball", 1: "People", 2: "players", 3: "human"}) == (1, 2, 3)
    for count in (1, None):
        assert find_person_classes("net.onnx", count, {0: "footballer"}, None) == (0,)
    assert _class_names({"names": "{0: 'ball', 1: 'player'}"}) == {0: "ball", 1: "player"}
    assert _class_names({"names": "['ball']"}) == _class_names({"names": "{'ball': 0}"})
    assert _class_names({"names": "['ball']"}) == {0: "ball"}
    for text in ("{'a': 'b'}", "f()", "'person'", "{'person'}"):
        assert _class_names({"names": text}) == _class_names({}) == {}


def test_nets_take_channels_and_grey_levels_as_in_their_training():
    image = np.array([[[[255, 51, 0]]]], np.uint8)  # RGB
    taken = {name: FORMS[name].prepare(image)[0, 0, 0] for name in FORMS}
    np.testing.assert_allclose(taken["yolox"], [0, 51, 255])
    np.testing.assert_allclose(taken["yolov8"], [1.0, 0.2, 0.0])
    np.testing.assert_allclose(taken["movenet"], [255, 51, 0])
    np.testing.assert_allclose(
        taken["rfdetr"], [(1 - 0.485) / 0.229, -0.2560 / 0.224, -0.406 / 0.225], atol=1e-3
    )
    np.testing.assert_allclose(
        taken["rtmdet"],
        [-103.53 / 57.375, (51 - 116.28) / 57.12, (255 - 123.675) / 58.395],
        rtol=1e-6,
    )


def test_an_unknown_form_is_refused_with_the_known_ones(tmp_path):
    file = tmp_path / "net.onnx"
    file.write_bytes(b"none")
    with pytest.raises(InputError, match=r"one of yolox: .*rtmdet: "):
        load_detectors(DetectionSettings(detector=f"onnx-yolo99:{file}"))


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
        middle = [np.average(np.arange(n), weights=crop.sum(k)) for k, n in enumerate((48, 64))]
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
