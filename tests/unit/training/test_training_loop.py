"""Labels of corrections, and the training of nets on them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.detection.interfaces import People
from worldpose.errors import InputError
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.fine_tuning import Training, fine_tune, split, train
from worldpose.training.keypoint_training import KeypointCrops, keypoint_batch
from worldpose.training.labels import LabelledPicture, PictureCache, read_labels, write_labels
from worldpose.training.metrics import average_precision, correct_keypoints
from worldpose.training.settings import FineTuningSettings, TrainingSettings

SETTINGS = TrainingSettings(steps=12, check_every=4, rate=0.05, seed=3)


class InterruptedTrainingError(Exception):
    pass


def line_fit(settings=SETTINGS, *, interrupted_after=None, scores=None):
    """A small net, in the memory layout of the shipped ones, that learns y = 2 x."""
    torch.manual_seed(settings.seed)
    net = nn.Sequential(nn.BatchNorm2d(2), nn.Conv2d(2, 2, 3, padding=1))
    net = net.to(memory_format=torch.channels_last)
    drawn = []

    def batch(rng):
        drawn.append(None)
        if interrupted_after is not None and len(drawn) > interrupted_after:
            raise InterruptedTrainingError
        return torch.from_numpy(rng.standard_normal((8, 2, 4, 4)).astype(np.float32))

    def score(net):
        if scores is not None:
            return scores.pop(0)
        x = torch.linspace(-1, 1, 64).reshape(2, 2, 4, 4)
        with torch.no_grad():
            return -float((net(x) - 2 * x).square().mean())

    return Training(net, batch, lambda net, x: (net(x) - 2 * x).square().mean(), score, settings)


def test_a_resumed_training_gives_the_weights_of_an_undisturbed_one(tmp_path):
    whole, first, second = line_fit(), line_fit(interrupted_after=6), line_fit()
    undisturbed = train(whole)
    checkpoint = tmp_path / "training.checkpoint"
    with pytest.raises(InterruptedTrainingError):
        train(first, checkpoint)
    lines = []
    resumed = train(second, checkpoint, lines.append)
    assert lines[0] == "resumes after step 4"
    # The loss before the first step is NaN.
    assert [(c.step, c.score) for c in resumed] == [(c.step, c.score) for c in undisturbed]
    assert [c.loss for c in resumed[1:]] == [c.loss for c in undisturbed[1:]]
    theirs = second.net.state_dict()
    for name, value in whole.net.state_dict().items():
        assert torch.equal(value, theirs[name]), name


def test_the_best_weights_are_kept_and_training_stops_early():
    # Without memory the mean is the weights of the step.
    changes = {"steps": 100, "check_every": 1, "patience": 2, "memory": 0.0}
    settings = SETTINGS.model_copy(update=changes)
    training = line_fit(settings, scores=[0.1, 0.5, 0.4, 0.3, 0.9])
    best = {}

    def say(line):
        if line.startswith("step 1 "):
            best.update({k: v.clone() for k, v in training.net.state_dict().items()})

    checks = train(training, progress=say)
    assert [check.step for check in checks] == [0, 1, 2, 3]
    for name, value in training.net.state_dict().items():
        assert torch.equal(value, best[name]), name


def test_what_is_no_checkpoint_of_this_training_is_refused(tmp_path):
    checkpoint = tmp_path / "training.checkpoint"
    train(line_fit(), checkpoint)
    with pytest.raises(InputError, match="settings"):
        train(line_fit(SETTINGS.model_copy(update={"rate": 0.1})), checkpoint)
    for content in (b"", b"\x80\x04cos\nsystem\n", b"{}"):
        checkpoint.write_bytes(content)
        with pytest.raises(InputError, match="checkpoint"):
            train(line_fit(), checkpoint)


def pictures(folder, count, people=1):
    """Small grey images of a bright person each."""
    made = []
    for number in range(count):
        path = folder / f"{number:03d}.png"
        picture = np.full((96, 96, 3), 60, dtype=np.uint8)
        picture[20:70, 40:60] = 220
        cv2.imwrite(str(path), picture)
        box = np.array([[40.0, 20.0, 60.0, 70.0]] * people).reshape(-1, 4)
        keypoints = np.linspace((42.0, 22.0), (58.0, 68.0), 17)[None].repeat(people, axis=0)
        visible = np.full((people, 17), 2, dtype=np.int8)
        made.append(LabelledPicture(path, box, keypoints, visible, np.zeros(people, dtype=bool)))
    return made


def test_parts_share_nothing_and_neighbours_stay_together(tmp_path):
    labelled = pictures(tmp_path, 100)
    parts = split(labelled, FineTuningSettings())
    numbers = [[int(p.path.stem) for p in part] for part in parts]
    assert [len(part) for part in numbers] == [60, 15, 25]
    assert sorted(number for part in numbers for number in part) == list(range(100))
    # Twenty runs of five: each is in one part.
    for run in range(20):
        holders = [part for part in numbers if {*part} & {*range(5 * run, 5 * run + 5)}]
        assert len(holders) == 1


@pytest.mark.parametrize("flag", [0, 1])
def test_keypoints_that_nothing_measures_are_refused_before_the_training(tmp_path, flag):
    labelled = pictures(tmp_path, 8)
    split(labelled, FineTuningSettings(), "keypoints")
    for picture in labelled:
        picture.visible[:] = flag
    split(labelled, FineTuningSettings(), "people")
    with pytest.raises(InputError, match="34 px or more with a labelled torso and visible"):
        split(labelled, FineTuningSettings(), "keypoints")


@pytest.mark.parametrize(
    ("kind", "net"),
    [pytest.param("people", PeopleNet, marks=pytest.mark.slow), ("keypoints", KeypointNet)],
)
def test_a_version_that_is_no_better_is_told_apart(tmp_path, kind, net):
    torch.manual_seed(0)
    start, weights = tmp_path / "start.safetensors", tmp_path / "new.safetensors"
    save_weights(start, net())
    # A rate this small changes no detection.
    training = TrainingSettings(steps=1, rate=1e-9, check_every=1)
    lines = []
    result = fine_tune(
        kind,
        pictures(tmp_path, 8),
        weights,
        FineTuningSettings(training=training),
        start=start,
        progress=lines.append,
    )
    assert not result.better and result.after == result.before
    assert result.steps == 1 and len(lines) == 1
    assert load_weights(weights, net()) is not None
    assert not weights.with_suffix(".checkpoint").exists()


AS_IS = AugmentationSettings(strength=0, recoloured=0, grey=0, fog=0, soft=0, coded=0, grain=0)
LEFT_EAR, RIGHT_EAR = 3, 4


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A grey image of one box of 60 x 120 px: a red left ear and a blue right one."""
    path: Path = tmp_path_factory.mktemp("pictures") / "a.png"
    picture = np.full((300, 400, 3), 60, dtype=np.uint8)
    left, right = (230, 120), (190, 150)
    cv2.circle(picture, left, 6, (0, 0, 255), -1)
    cv2.circle(picture, right, 6, (255, 0, 0), -1)
    cv2.imwrite(str(path), picture)
    keypoints = np.full((1, 17, 2), np.nan)
    keypoints[0, LEFT_EAR], keypoints[0, RIGHT_EAR] = left, right
    visible = np.where(np.isfinite(keypoints[..., 0]), 2, 0).astype(np.int8)
    box = np.array([[180.0, 90.0, 240.0, 210.0]])
    return LabelledPicture(path, box, keypoints, visible, np.array([False]))


def test_labels_lie_on_what_they_name_in_turned_mirrored_and_distant_crops(labelled):
    settings = KeypointCrops(
        crops=24, hidden=0, smaller=0.5, astray=0, elsewhere=0, turned=1, looks=AS_IS
    )
    batch = keypoint_batch([(labelled, 0)], PictureCache(), settings, np.random.default_rng(0))
    sides = set()
    for crop, keypoints in zip(batch.crops.astype(int), batch.keypoints, strict=True):
        red = crop[..., 0] - crop[..., 2]
        mirrored = _mirrored(keypoints)
        sides.add(mirrored)
        # In a mirror the left ear is a right one: the red dot then is labelled the right ear.
        is_red, is_blue = (RIGHT_EAR, LEFT_EAR) if mirrored else (LEFT_EAR, RIGHT_EAR)
        for joint, level in ((is_red, red), (is_blue, -red)):
            rows, columns = np.nonzero(level > 0.6 * level.max())
            middle = np.array([columns.mean(), rows.mean()])
            # A dot of 10 px seen in coarse pixels has its middle within half of one.
            assert np.linalg.norm(middle - keypoints[joint]) < 1.3
    assert sides == {True, False}


def _mirrored(keypoints):
    """Whether a crop is mirrored, by what is labelled left and right.

    As it is, the left ear is 40 px right of the right one and 30 px higher. In a mirror the blue
    dot is labelled left: 40 px right of the red one, 30 px lower. No turn comes to 37 degrees.
    """
    return bool(keypoints[LEFT_EAR, 1] > keypoints[RIGHT_EAR, 1])


@pytest.fixture
def picture(tmp_path):
    keypoints = np.arange(68.0).reshape(2, 17, 2)
    visible = np.full((2, 17), 2, dtype=np.int8)
    visible[0, 3], visible[1, 4] = 0, 1
    keypoints[0, 3] = np.nan
    return LabelledPicture(
        path=tmp_path / "a.jpg",
        boxes=np.array([[1.0, 2.0, 31.0, 62.0], [-0.5, -0.5, 8.0, 9.0]]),
        keypoints=keypoints,
        visible=visible,
        ignored=np.array([False, True]),
    )


def test_labels_come_back_as_they_were(tmp_path, picture):
    write_labels(tmp_path / "labels.json", [picture], (1920, 1080))
    (read,) = read_labels(tmp_path / "labels.json")
    assert read.path == picture.path
    fields = ("boxes", "keypoints", "visible", "ignored")
    for field in fields:
        np.testing.assert_array_equal(getattr(read, field), getattr(picture, field))
    nobody = replace(picture, **{field: getattr(picture, field)[:0] for field in fields})
    write_labels(tmp_path / "labels.json", [nobody], (1920, 1080))
    (read,) = read_labels(tmp_path / "labels.json")
    assert read.boxes.shape == (0, 4) and read.keypoints.shape == (0, 17, 2)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("annotations", {"keypoints": [1.0] * 50}),
        ("annotations", {"bbox": [float("nan"), 0.0, 1.0, 1.0]}),
        ("annotations", {"image_id": 99}),
        ("annotations", {"bbox": [9.0, 9.0, -1.0, 1.0]}),
        ("annotations", {"keypoints": [1.0, 1.0, 0.93] * 17}),
        ("annotations", {"category_id": 7}),
        ("images", {"width": 480}),
        ("categories", {"keypoints": ["nose", "left_foot"]}),
        ("images", {"file_name": "../../secret.jpg"}),
        ("images", {"id": None}),
    ],
)
def test_damaged_labels_are_refused(tmp_path, picture, part, change):
    cv2.imwrite(str(picture.path), np.zeros((108, 192, 3), dtype=np.uint8))
    file = tmp_path / "labels.json"
    write_labels(file, [picture], (192, 108))
    assert len(read_labels(file)) == 1
    dataset = json.loads(file.read_text())
    dataset[part][0] |= change
    file.write_text(json.dumps(dataset))
    with pytest.raises(InputError, match=r"labels\.json"):
        read_labels(file)
    dataset["images"] *= 2
    file.write_text(json.dumps(dataset))
    with pytest.raises(InputError, match=r"labels\.json"):
        read_labels(file)


def test_categories_say_who_is_a_person_and_in_which_order_joints_are(tmp_path, picture, caplog):
    file = tmp_path / "labels.json"
    write_labels(file, [picture], (1920, 1080))
    dataset = json.loads(file.read_text())
    dataset["categories"][0]["keypoints"].reverse()
    dataset["categories"] += [{"id": 2, "name": "ball"}, {"id": 3, "name": "Referee"}]
    for person in dataset["annotations"]:
        triples = np.reshape(person["keypoints"], (17, 3))[::-1]
        person["keypoints"] = triples.ravel().tolist()
    ball = {"id": 9, "image_id": 0, "category_id": 2, "bbox": [1, 1, 8, 8], "iscrowd": 0}
    dataset["annotations"] += [ball, {**ball, "category_id": 3}]
    file.write_text(json.dumps(dataset))
    (read,) = read_labels(file)
    np.testing.assert_array_equal(read.keypoints[:-1], picture.keypoints)
    assert read.boxes[-1].tolist() == [1.0, 1.0, 9.0, 9.0] and not read.visible[-1].any()
    assert "left out annotations that are no people: 1 of ball" in caplog.text


def truth(boxes, ignored=None):
    boxes = np.array(boxes, dtype=float).reshape(-1, 4)
    count = len(boxes)
    return LabelledPicture(
        path=Path("none.jpg"),
        boxes=boxes,
        keypoints=np.full((count, 17, 2), np.nan),
        visible=np.zeros((count, 17), dtype=np.int8),
        ignored=np.array([False] * count if ignored is None else ignored, dtype=bool),
    )


def found(boxes, scores):
    return People(np.array(boxes, dtype=float).reshape(-1, 4), np.array(scores, dtype=float))


NEAR, FAR, AWAY = [0, 0, 20, 40], [100, 0, 120, 40], [300, 0, 320, 40]


@pytest.mark.parametrize(
    ("boxes", "people", "area"),
    [
        # Precision 1 at recall 1/2, 2/3 at recall 1: the area is 1/2 * 1 + 1/2 * 2/3.
        ([NEAR, AWAY, FAR], [NEAR, FAR], 5 / 6),
        # The second box on a person is false, though it would be right alone.
        ([NEAR, NEAR, FAR], [NEAR, FAR], 5 / 6),
        # 20 x 40 boxes shifted along x by s overlap by (20 - s) / (20 + s): 0.5 at 20 / 3.
        ([[6.6, 0, 26.6, 40]], [NEAR], 1.0),
        ([[6.7, 0, 26.7, 40]], [NEAR], 0.0),
        ([NEAR], [], np.nan),
    ],
)
def test_area_under_precision_over_recall(boxes, people, area):
    said = found(boxes, [0.9, 0.8, 0.7][: len(boxes)])
    assert average_precision([said], [truth(people)]) == pytest.approx(area, nan_ok=True)


def test_a_keypoint_within_a_fifth_of_the_torso_is_correct():
    # Shoulders 40 px apart, 30 px above both hips, which are on one point: a torso of 50 px.
    person = np.zeros((1, 17, 2))
    person[0, 5], person[0, 6] = (40.0, 0.0), (0.0, 0.0)
    person[0, 11] = person[0, 12] = (0.0, 30.0)
    found = person.copy()
    found[0, 0, 0] = 10.0
    found[0, 11, 1] += 10.01
    found[0, 9], person[0, 10] = np.nan, np.nan
    correct = correct_keypoints(found, person)
    assert np.isnan(correct[0, 10])
    assert np.flatnonzero(correct[0] == 0.0).tolist() == [9, 11]
