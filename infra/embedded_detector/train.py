"""Makes the weights that ship with the project: renders scenes, trains both nets, scores them.

    python infra/embedded_detector/train.py FOLDER

Every part goes on where it was interrupted. The detector is trained from nothing, then on with more
crowds. Weights and figures.json end in FOLDER; weights with another seed or torch differ in their
bytes, not in their figures' size.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from scenes import CHECKING, CROWDS, HELD_OUT, TRAINING, VARIETY, read_set, render_set

from worldpose.detection.embedded import EmbeddedDetector, EmbeddedPose
from worldpose.detection.embedded_nets import KeypointNet, PeopleNet
from worldpose.detection.embedded_weights import load_weights, save_weights
from worldpose.training import LabelledPicture, PictureCache, TrainingSettings
from worldpose.training.nets import LEAST_HEIGHT, train_keypoint_net, train_people_net
from worldpose.training.scoring import HEIGHTS, apart, found_people, score_keypoints, score_people

SEED = 1
SCENES = {
    "training": (TRAINING, 50, 4, 2),
    "variety": (VARIETY, 200, 2, 1),
    "crowds": (CROWDS, 60, 2, 2),
    "checking": (CHECKING, 10, 4, 2),
    "held_out": (HELD_OUT, 10, 4, 2),
}
"""Kind, scenes, views of each and moments of each view."""
LEARNED = (("training", "variety"), ("training", "variety", "crowds"))
"""What each part of a training learns from."""


def part(steps: int, rate: float, seed: int) -> TrainingSettings:
    """Return how a part of a training goes."""
    return TrainingSettings(steps=steps, check_every=500, rate=rate, seed=seed, bfloat16=True)


PEOPLE = (part(6000, 1.5e-3, SEED), part(5000, 1e-3, 3))
KEYPOINTS = part(8000, 1.5e-3, SEED)
ABOUT = {"trained-on": "rendered scenes", "seed": str(SEED)}


def main(folder: Path, parts: Sequence[str]) -> None:
    """Render, train and score what is named: `scenes`, `people`, `keypoints`, `figures`."""
    torch.set_num_threads(1)
    if "scenes" in parts:
        for name, (kind, count, views, frames) in SCENES.items():
            for line in render_set(folder / name, kind, count, views=views, frames=frames):
                say(line)
    cache = PictureCache()
    learned = [[q for name in names for q in read_set(folder / name)] for names in LEARNED]
    checked = read_set(folder / "checking")[::2]
    if "people" in parts:
        train_people(folder, learned, checked, cache)
    if "keypoints" in parts:
        train_keypoints(folder, learned[0], checked, cache)
    if "figures" in parts:
        figures = score(folder, read_set(folder / "held_out"), cache)
        (folder / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
        say(json.dumps(figures))


def train_people(
    folder: Path,
    learned: Sequence[Sequence[LabelledPicture]],
    checked: Sequence[LabelledPicture],
    cache: PictureCache,
) -> None:
    """Train the detector; its weights are those of the best check."""
    torch.manual_seed(SEED)
    net = PeopleNet()
    for number, (pictures, how) in enumerate(zip(learned, PEOPLE, strict=True)):
        checkpoint = folder / f"people{number}.checkpoint"
        train_people_net(net, pictures, checked, cache, how, checkpoint=checkpoint, progress=say)
    save_weights(folder / "embedded_people.safetensors", net, ABOUT)


def train_keypoints(
    folder: Path,
    learned: Sequence[LabelledPicture],
    checked: Sequence[LabelledPicture],
    cache: PictureCache,
) -> None:
    """Train the pose estimator; its weights are those of the best check."""
    torch.manual_seed(SEED)
    net = KeypointNet()
    checkpoint = folder / "keypoints.checkpoint"
    train_keypoint_net(net, learned, checked, cache, KEYPOINTS, checkpoint=checkpoint, progress=say)
    save_weights(folder / "embedded_keypoints.safetensors", net, ABOUT)


def score(
    folder: Path, pictures: Sequence[LabelledPicture], cache: PictureCache
) -> dict[str, object]:
    """Return the figures on scenes that nothing was learned from or chosen by."""
    detector = EmbeddedDetector(load_weights(folder / "embedded_people.safetensors", PeopleNet()))
    pose = EmbeddedPose(load_weights(folder / "embedded_keypoints.safetensors", KeypointNet()))
    classes = ["all", *(f"{low:g} to {high:g} px" for low, high in HEIGHTS)]
    found, kept = (found_people(detector, pictures, cache, each) for each in (None, pose))
    alone, stored, free = (
        dict(zip(classes, score_people(people, labels), strict=True))
        for people, labels in ((found, pictures), (kept, pictures), (kept, apart(pictures)))
    )
    limits = [(LEAST_HEIGHT, 1e9), *HEIGHTS]
    placed = {
        name: score_keypoints(pose, pictures, cache, each).__dict__
        for name, each in zip(classes, limits, strict=True)
    }
    return {
        "pictures": len(pictures),
        "ap50_of_the_detector": alone,
        "ap50": stored,
        "ap50_apart": free,
        "keypoints": placed,
    }


def say(line: str) -> None:
    """Print a line with the processor time so far."""
    print(f"{time.process_time():7.0f} s  {line}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or ["scenes", "people", "keypoints", "figures"])
