import cv2
import numpy as np
import pytest
import torch

from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.training.fine_tuning import fine_tune, split
from worldpose.training.labels import LabelledPicture
from worldpose.training.settings import FineTuningSettings, TrainingSettings


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
