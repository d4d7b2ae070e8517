"""Trains the weights that ship with the project: renders scenes, trains both nets, scores them.

    python infra/embedded_detector/train.py FOLDER [--share 1.0] [--real DATA --movenet FILE] \
        [--stills DATA] [scenes people keypoints figures]

A training has phases, each of which begins with the weights of the previous one. Every phase
resumes after an interruption, and ends with the same weights as without it. The last phases of
each net add real frames, see real_frames.py; without `--real` they are left out. With `--stills`
the detector's last phase learns from labelled stills of other stadiums instead, for comparison.
Weights and figures.json end in FOLDER; with another seed or torch their bytes differ, but metrics
are similar.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, TypeVar

import numpy as np
import torch
from real_frames import label_pair, read_panorama
from real_looks import RealLooks
from scenes import CHECKING, CROWDS, FAR, HELD_OUT, TRAINING, VARIETY, read_set, render_set

from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.detection.bundled_pose import BundledPoseEstimator
from worldpose.detection.settings import DetectionSettings
from worldpose.geometry.boxes import box_iou
from worldpose.training.fine_tuning import MIN_HEIGHT, train_net
from worldpose.training.keypoint_training import KeypointCrops
from worldpose.training.labels import LabelledPicture, PictureCache, read_labels
from worldpose.training.metrics import average_precision, detect_labelled, score_keypoints
from worldpose.training.people_training import PeopleWindows
from worldpose.training.settings import TrainingSettings

Net = TypeVar("Net", PeopleNet, KeypointNet)
RealImages = Literal["frames", "stills"]
"""Frames: see real_frames.py. Stills: of benchmarks/stills.py, from other stadiums."""

SCENES: Final = {
    "training": (TRAINING, 50, 4, 2),
    "variety": (VARIETY, 139, 2, 1),
    "crowds": (CROWDS, 88, 2, 2),
    "far": (FAR, 40, 3, 1),
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
        learned: sets to learn from, and how often each of their images counts.
        real: the real images that it learns from, too; then no held-out renderings choose its
            weights.
    """

    steps: int
    planned: int
    rate: float
    seed: int
    learned: Mapping[str, int]
    real: RealImages | None = None

    def settings(self, share: float) -> TrainingSettings:
        """Return the training settings for a share of the phase."""
        steps, planned = (max(round(share * each), 2) for each in (self.steps, self.planned))
        return TrainingSettings(
            steps=steps,
            planned=planned,
            check_every=max(round(share * 1000), 1),
            keep="last" if self.real else "best",
            rate=self.rate,
            seed=self.seed,
            bfloat16=True,
        )


FEW: Final = {"training": 1, "variety": 1}
ALL: Final = {**FEW, "crowds": 1}
PHASES: Final = {
    "people": (
        Phase(6000, 6000, 1.5e-3, 1, FEW),
        Phase(3000, 8000, 1e-3, 3, ALL),
        Phase(2000, 2000, 6e-4, 4, ALL),
        Phase(
            *(4000, 4000, 1e-3, 5),
            {"training": 2, "far": 2, "crowds": 1, "panorama": 3, "pair": 4},
            real="frames",
        ),
        Phase(
            *(6000, 6000, 1e-3, 6),
            {"training": 2, "far": 1, "crowds": 3, "panorama": 3, "pair": 4},
            real="frames",
        ),
        Phase(
            *(4000, 4000, 1e-3, 5),
            {"training": 2, "far": 2, "crowds": 1, "stills": 25},
            real="stills",
        ),
    ),
    "keypoints": (
        Phase(8000, 8000, 1.5e-3, 1, FEW),
        Phase(6000, 6000, 1e-3, 2, FEW),
        Phase(3750, 5000, 1e-3, 11, ALL),
        Phase(3500, 3500, 1e-3, 7, {"training": 1, "crowds": 1, "pair": 7}, real="frames"),
        Phase(5000, 5000, 1e-3, 9, {"training": 1, "crowds": 1, "pair": 7}, real="frames"),
    ),
}
"""Phases of the shipped weights, with exceptions in the model card."""
SMALL_WINDOWS: Final = PeopleWindows(height=(20.0, 160.0), aimed=0.65, looks=RealLooks())
"""Windows of the detector's last phases."""
REAL_CROPS: Final = KeypointCrops(looks=RealLooks())
"""Crops of the pose estimator's last phases."""


def main(
    folder: Path,
    parts: Sequence[str],
    share: float,
    data: Mapping[RealImages, Path],
    movenet: Path | None = None,
) -> None:
    """Run the named parts: `scenes`, `people`, `keypoints`, `figures`.

    Args:
        folder: of all outputs.
        parts: parts to run.
        share: of scenes and steps [1]; less than 1 is a smoke test only.
        data: folders of real images; phases that learn from others are left out.
        movenet: labels the real frames' joints, as ONNX; needed with real frames.
    """
    torch.set_num_threads(1)
    if "scenes" in parts:
        for name, (kind, count, views, frames) in SCENES.items():
            scenes = max(round(share * count), 1)
            for line in render_set(folder / name, kind, scenes, views=views, frames=frames):
                say(line)
        if "frames" in data and movenet is not None:
            for line in label_pair(data["frames"], movenet, folder / "pair"):
                say(line)
    cache = PictureCache()
    if "people" in parts:
        train_phases(folder, "people", PeopleNet(), cache, share, data)
    if "keypoints" in parts:
        train_phases(folder, "keypoints", KeypointNet(), cache, share, data)
    if "figures" in parts:
        figures = score(folder, read_set(folder / "held_out"), cache)
        (folder / "figures.json").write_text(json.dumps(figures, indent=2) + "\n")
        say(json.dumps(figures))


def train_phases(
    folder: Path,
    name: str,
    net: Net,
    cache: PictureCache,
    share: float,
    data: Mapping[RealImages, Path],
) -> None:
    """Train a net through its phases; those of real images that DATA lacks are left out."""
    checked = read_set(folder / "checking")[::2]
    phases = [phase for phase in PHASES[name] if phase.real is None or phase.real in data]
    for number, phase in enumerate(phases):
        done = folder / f"{name}-{number}.safetensors"
        if not done.exists():
            say(f"{name}: phase {number + 1} of {len(phases)}")
            torch.manual_seed(phase.seed)
            net = type(net)() if number == 0 else net
            learned = [
                picture
                for each, times in phase.learned.items()
                for picture in times * _read(folder, each, data)
            ]
            train_phase(net, phase, (learned, checked, cache), share, done)
            trained_on = (
                f"rendered scenes and real {phase.real}" if phase.real else "rendered scenes"
            )
            save_weights(done, net, {"trained-on": trained_on, "seed": str(phase.seed)})
        net = load_weights(done, type(net)())
    (folder / f"embedded_{name}.safetensors").write_bytes(done.read_bytes())


def train_phase(
    net: PeopleNet | KeypointNet,
    phase: Phase,
    given: tuple[list[LabelledPicture], list[LabelledPicture], PictureCache],
    share: float,
    done: Path,
) -> None:
    """Train a net through one phase, in place.

    Args:
        net: begins with the weights of the phase before.
        phase: steps and rate.
        given: images to learn from, images of the checks, and their cache.
        share: of the steps [1].
        done: file of the result; the checkpoint lies next to it.
    """
    learned, checked, cache = given
    settings, checkpoint = phase.settings(share), done.with_suffix(".checkpoint")
    cut = (SMALL_WINDOWS if isinstance(net, PeopleNet) else REAL_CROPS) if phase.real else None
    train_net(net, learned, checked, cache, settings, cut, checkpoint=checkpoint, progress=say)


def _read(folder: Path, name: str, data: Mapping[RealImages, Path]) -> list[LabelledPicture]:
    if name == "panorama":
        return read_panorama(data["frames"])
    if name == "stills":
        return read_labels(data["stills"] / "stills" / "labels.json")
    return read_set(folder / name)


def score(
    folder: Path, pictures: Sequence[LabelledPicture], cache: PictureCache
) -> dict[str, object]:
    """Return metrics on scenes outside training and selection."""
    detector = BundledDetector(load_weights(folder / "embedded_people.safetensors", PeopleNet()))
    pose = BundledPoseEstimator(
        load_weights(folder / "embedded_keypoints.safetensors", KeypointNet())
    )
    heights = ((34.0, 46.0), (52.0, 70.0), (70.0, 160.0))
    classes = ["all", *(f"{low:g} to {high:g} px" for low, high in heights)]
    found, kept = (detect_labelled(detector, pictures, cache, each) for each in (None, pose))
    beside = detect_labelled(detector, pictures, cache, pose, DetectionSettings(find_occluded=True))
    alone, stored, free, more = (
        {
            name: average_precision(people, labels, each)
            for name, each in zip(classes, ((0.0, np.inf), *heights), strict=True)
        }
        for people, labels in (
            (found, pictures),
            (kept, pictures),
            (kept, ignore_crowded(pictures)),
            (beside, pictures),
        )
    )
    limits = [(MIN_HEIGHT, 1e9), *heights]
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
    parser.add_argument("--real", type=Path, metavar="DATA", help="adds real frames")
    parser.add_argument("--movenet", type=Path, metavar="FILE", help="labels their joints")
    parser.add_argument(
        "--stills", type=Path, metavar="DATA", help="adds labelled stills of other stadiums instead"
    )
    given = parser.parse_args()
    if (given.real is None) != (given.movenet is None):
        parser.error("--real and --movenet go together")
    if given.real is not None and given.stills is not None:
        parser.error("--real and --stills are two different trainings: give one")
    images: dict[RealImages, Path | None] = {"frames": given.real, "stills": given.stills}
    real_images = {name: path for name, path in images.items() if path is not None}
    main(given.folder, given.parts, given.share, real_images, given.movenet)
