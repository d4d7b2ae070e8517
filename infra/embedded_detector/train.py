"""Trains the weights that ship with the project: renders scenes, trains both nets, scores them.

    python infra/embedded_detector/train.py FOLDER [--share 1.0] [scenes people keypoints figures]

A training has phases, each of which begins with the weights of the previous one. Every phase
resumes after an interruption, and ends with the same weights as without it. Weights and
figures.json end in FOLDER; with another seed or torch their bytes differ, but metrics are similar.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import torch
from scenes import CHECKING, CROWDS, HELD_OUT, TRAINING, VARIETY, read_set, render_set

from worldpose.detection import DetectionSettings
from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.detection.bundled_pose import BundledPoseEstimator
from worldpose.geometry.boxes import box_iou
from worldpose.training import LabelledPicture, PictureCache, TrainingSettings
from worldpose.training.fine_tuning import MIN_HEIGHT, train_keypoint_net, train_people_net
from worldpose.training.metrics import (
    HEIGHTS,
    detect_labelled,
    score_keypoints,
    score_people,
)

Net = TypeVar("Net", PeopleNet, KeypointNet)

SCENES: Final = {
    "training": (TRAINING, 50, 4, 2),
    "variety": (VARIETY, 139, 2, 1),
    "crowds": (CROWDS, 88, 2, 2),
    "checking": (CHECKING, 10, 4, 2),
    "held_out": (HELD_OUT, 10, 4, 2),
}
"""Kind, scenes, views of each and moments of each view."""


def ignore_crowded(
    pictures: Sequence[LabelledPicture], share: float = 0.3
) -> list[LabelledPicture]:
    """Return the images with people ignored whose box overlaps another's more than `share`.

    Args:
        pictures: with the truth.
        share: intersection over union of two people's boxes [1].
    """
    kept = []
    for picture in pictures:
        common = box_iou(picture.boxes, picture.boxes)
        np.fill_diagonal(common, 0.0)
        crowded = (common > share).any(axis=1)
        kept.append(replace(picture, ignored=picture.ignored | crowded))
    return kept


@dataclass(frozen=True)
class Phase:
    """A part of a training.

    Attributes:
        steps: batches.
        planned: batches over which the learning rate would have decayed fully.
        rate: highest learning rate [1].
        seed: of its batches.
        learned: sets of scenes to learn from.
    """

    steps: int
    planned: int
    rate: float
    seed: int
    learned: tuple[str, ...]

    def settings(self, share: float) -> TrainingSettings:
        """Return the training settings for a share of the phase."""
        steps, planned = (max(round(share * each), 2) for each in (self.steps, self.planned))
        return TrainingSettings(
            steps=steps,
            planned=planned,
            check_every=max(round(share * 1000), 1),
            rate=self.rate,
            seed=self.seed,
            bfloat16=True,
        )


FEW: Final = ("training", "variety")
ALL: Final = (*FEW, "crowds")
PHASES: Final = {
    "people": (
        Phase(6000, 6000, 1.5e-3, 1, FEW),
        Phase(3000, 8000, 1e-3, 3, ALL),
        Phase(2000, 2000, 6e-4, 4, ALL),
    ),
    "keypoints": (
        Phase(8000, 8000, 1.5e-3, 1, FEW),
        Phase(6000, 6000, 1e-3, 2, FEW),
        Phase(3750, 5000, 1e-3, 11, ALL),
    ),
}
"""Phases of the shipped weights, with exceptions in the model card."""


def main(folder: Path, parts: Sequence[str], share: float) -> None:
    """Run the named parts: `scenes`, `people`, `keypoints`, `figures`.

    Args:
        folder: of all outputs.
        parts: parts to run.
        share: of scenes and steps [1]; less than 1 is a smoke test only.
    """
    torch.set_num_threads(1)
    if "scenes" in parts:
        for name, (kind, count, views, frames) in SCENES.items():
            scenes = max(round(share * count), 1)
            for line in render_set(folder / name, kind, scenes, views=views, frames=frames):
                say(line)
    cache = PictureCache()
    if "people" in parts:
        train(folder, "people", PeopleNet(), train_people_net, cache, share)
    if "keypoints" in parts:
        train(folder, "keypoints", KeypointNet(), train_keypoint_net, cache, share)
    if "figures" in parts:
        figures = score(folder, read_set(folder / "held_out"), cache)
        (folder / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
        say(json.dumps(figures))


def train(
    folder: Path,
    name: str,
    net: Net,
    how: Callable[..., object],
    cache: PictureCache,
    share: float,
) -> None:
    """Train a net through its phases; each phase's weights are those of its best check."""
    checked = read_set(folder / "checking")[::2]
    for number, phase in enumerate(PHASES[name]):
        done = folder / f"{name}-{number}.safetensors"
        if not done.exists():
            say(f"{name}: phase {number + 1} of {len(PHASES[name])}")
            torch.manual_seed(phase.seed)
            net = type(net)() if number == 0 else net
            how(
                *(net, [q for each in phase.learned for q in read_set(folder / each)]),
                *(checked, cache, phase.settings(share)),
                checkpoint=folder / f"{name}-{number}.checkpoint",
                progress=say,
            )
            save_weights(done, net, {"trained-on": "rendered scenes", "seed": str(phase.seed)})
        net = load_weights(done, type(net)())
    (folder / f"embedded_{name}.safetensors").write_bytes(done.read_bytes())


def score(
    folder: Path, pictures: Sequence[LabelledPicture], cache: PictureCache
) -> dict[str, object]:
    """Return metrics on scenes outside training and selection."""
    detector = BundledDetector(load_weights(folder / "embedded_people.safetensors", PeopleNet()))
    pose = BundledPoseEstimator(
        load_weights(folder / "embedded_keypoints.safetensors", KeypointNet())
    )
    classes = ["all", *(f"{low:g} to {high:g} px" for low, high in HEIGHTS)]
    found, kept = (detect_labelled(detector, pictures, cache, each) for each in (None, pose))
    beside = detect_labelled(detector, pictures, cache, pose, DetectionSettings(find_occluded=True))
    alone, stored, free, more = (
        dict(zip(classes, score_people(people, labels), strict=True))
        for people, labels in (
            (found, pictures),
            (kept, pictures),
            (kept, ignore_crowded(pictures)),
            (beside, pictures),
        )
    )
    limits = [(MIN_HEIGHT, 1e9), *HEIGHTS]
    placed = {
        name: score_keypoints(pose, pictures, cache, each).__dict__
        for name, each in zip(classes, limits, strict=True)
    }
    return {
        "pictures": len(pictures),
        "ap50_of_the_detector": alone,
        "ap50": stored,
        "ap50_apart": free,
        "ap50_looking_beside": more,
        "keypoints": placed,
    }


def say(line: str) -> None:
    """Print a line with the processor time so far."""
    print(f"{time.process_time():7.0f} s  {line}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", default=["scenes", "people", "keypoints", "figures"])
    parser.add_argument("--share", type=float, default=1.0)
    given = parser.parse_args()
    main(given.folder, given.parts, given.share)
