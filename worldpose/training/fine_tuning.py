"""Fine-tuning of a net on reviewed labels, adopted only if it scores better (D5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from data_contracts.finetune import NetKind
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.detection.models import BUNDLED_WEIGHTS
from worldpose.errors import InputError
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.keypoint_training import KeypointCrops
from worldpose.training.labels import LabelledPicture, PictureCache
from worldpose.training.people_training import PeopleWindows
from worldpose.training.settings import FineTuningSettings
from worldpose.training.training_loop import (
    keypoint_score,
    people_score,
    train_keypoint_net,
    train_people_net,
)

Pictures = Sequence[LabelledPicture]

NET_METRICS: dict[NetKind, str] = {"people": "ap50", "keypoints": "pck"}
"""Metric of each net: AP50 of boxes, share of keypoints within 0.2 torsos."""
MILD = AugmentationSettings(
    strength=0.4, recoloured=0.1, grey=0.0, fog=0.0, soft=0.1, coded=0.1, grain=0.3
)
"""Augmentation for fine-tuning, mild: the labelled frames already show the footage that a version
is for, so air, light and kits of other footage are not needed."""
BLOCKS = 20
"""Blocks of consecutive frames that stay together: neighbours in a video are almost the same."""


@dataclass(frozen=True, eq=False)
class FineTuned:
    """Result of fine-tuning.

    Attributes:
        learned: frames in the training set.
        held_out: frames in the test set.
        before: metric of the initial weights [1].
        after: metric of the final weights [1].
        steps: done.
        better: whether the metric rose by at least the required gain.
    """

    learned: Pictures
    held_out: Pictures
    before: float
    after: float
    steps: int
    better: bool


def fine_tune(
    kind: NetKind,
    pictures: Pictures,
    weights: Path,
    settings: FineTuningSettings | None = None,
    *,
    start: Path | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> FineTuned:
    """Fine-tune a net on labels and return its metrics; the weights are written in any case.

    Args:
        kind: which net.
        pictures: with reviewed labels, in the order of recording.
        weights: the file to write; with the checkpoint next to it a killed training resumes.
        settings: the defaults if None.
        start: initial weights; the shipped ones if None.
        progress: receives a line at every check.

    Raises:
        InputError: too few frames, a subset without people, or weights of another net.
    """
    settings = settings or FineTuningSettings()
    learned, checked, held_out = split(pictures, settings)
    cache, training = PictureCache(), settings.training
    checkpoint = weights.with_suffix(".checkpoint")
    torch.manual_seed(training.seed)
    if kind == "people":
        people = load_weights(start or BUNDLED_WEIGHTS[0], PeopleNet())
        before = people_score(people, held_out, cache)
        checks = train_people_net(
            people,
            learned,
            checked,
            cache,
            training,
            windows=PeopleWindows(looks=MILD),
            checkpoint=checkpoint,
            progress=progress,
        )
        after = people_score(people, held_out, cache)
        save_weights(weights, people)
    else:
        keypoints = load_weights(start or BUNDLED_WEIGHTS[1], KeypointNet())
        before = keypoint_score(keypoints, held_out, cache)
        checks = train_keypoint_net(
            keypoints,
            learned,
            checked,
            cache,
            training,
            crops=KeypointCrops(looks=MILD),
            checkpoint=checkpoint,
            progress=progress,
        )
        after = keypoint_score(keypoints, held_out, cache)
        save_weights(weights, keypoints)
    checkpoint.unlink(missing_ok=True)
    better = after >= before + settings.gain and after > before
    return FineTuned(learned, held_out, before, after, checks[-1].step, better)


def split(
    pictures: Pictures, settings: FineTuningSettings
) -> tuple[list[LabelledPicture], list[LabelledPicture], list[LabelledPicture]]:
    """Return the frames for training, for validation, and for the test.

    Raises:
        InputError: a subset without people.
    """
    count = min(BLOCKS, len(pictures))
    blocks = np.array_split(np.arange(len(pictures)), max(count, 1))
    order = np.random.default_rng([settings.training.seed, 0x5B1]).permutation(len(blocks))
    held = max(round(settings.held_out * count), 1)
    chosen = held + max(round(settings.checked * count), 1)
    parts = []
    for name, places in (
        ("training", order[chosen:]),
        ("validation", order[held:chosen]),
        ("the test", order[:held]),
    ):
        part = [pictures[index] for place in sorted(places) for index in blocks[place]]
        if not any((~picture.ignored).any() for picture in part):
            raise InputError(
                "labels",
                expected="people in the images for training, for validation and for the test",
                found=f"no people in the images for {name}, of {len(pictures)} images in all",
                todo="Label more images; 200 are a good start.",
            )
        parts.append(part)
    return parts[0], parts[1], parts[2]
