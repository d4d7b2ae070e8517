from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.errors import InputError
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.fine_tuning import Training, fine_tune, split, train
from worldpose.training.keypoint_training import KeypointCrops, keypoint_batch
from worldpose.training.labels import LabelledPicture, PictureCache
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
NOSE, LEFT_EAR, RIGHT_EAR = 0, 3, 4


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
