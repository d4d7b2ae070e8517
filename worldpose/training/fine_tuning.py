"""A net made better at what reviewed labels show, or left as it was (D5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from data_contracts.finetune import NetKind
from worldpose.detection.bundled import EMBEDDED
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet
from worldpose.detection.bundled_weights import load_weights, save_weights
from worldpose.errors import InputError
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.keypoint_training import KeypointCrops
from worldpose.training.labels import LabelledPicture
from worldpose.training.nets import (
    keypoint_figure,
    people_figure,
    train_keypoint_net,
    train_people_net,
)
from worldpose.training.people_training import PeopleWindows
from worldpose.training.pictures import PictureCache
from worldpose.training.settings import FineTuningSettings

Pictures = Sequence[LabelledPicture]

FIGURES: dict[NetKind, str] = {"people": "ap50", "keypoints": "pck"}
"""What each net is judged by: boxes at an overlap of a half, keypoints within 0.2 torsos."""
MILD = AugmentationSettings(
    strength=0.4, recoloured=0.1, grey=0.0, fog=0.0, soft=0.1, coded=0.1, grain=0.3
)
"""Looks of the pictures that nets are fine-tuned on: these show the footage that a version is for,
and the air, light and kits of others are not asked for."""
BLOCKS = 20
"""Runs of consecutive pictures that stay together: neighbours in a video are almost the same."""


@dataclass(frozen=True, eq=False)
class FineTuned:
    """What fine-tuning came to.

    Attributes:
        learned: pictures learned from.
        held_out: pictures that the figures are of.
        before: figure of the weights that training began from [1].
        after: figure of those that it ended with [1].
        steps: done.
        better: by more than the gain asked for.
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
    """Return what training on labels made of a net; its weights are written in any case.

    Args:
        kind: which net.
        pictures: with reviewed labels, in the order they were taken.
        weights: the file to write; a checkpoint beside it lets a killed training go on.
        settings: the defaults if None.
        start: weights to begin from; the shipped ones if None.
        progress: takes a line at every check.

    Raises:
        InputError: too few pictures, nobody in some part of them, or weights of another net.
    """
    settings = settings or FineTuningSettings()
    learned, checked, held_out = split(pictures, settings)
    cache, training = PictureCache(), settings.training
    checkpoint = weights.with_suffix(".checkpoint")
    torch.manual_seed(training.seed)
    if kind == "people":
        people = load_weights(start or EMBEDDED[0], PeopleNet())
        before = people_figure(people, held_out, cache)
        checks = train_people_net(
            *(people, learned, checked, cache, training),
            windows=PeopleWindows(looks=MILD),
            checkpoint=checkpoint,
            progress=progress,
        )
        after = people_figure(people, held_out, cache)
        save_weights(weights, people)
    else:
        keypoints = load_weights(start or EMBEDDED[1], KeypointNet())
        before = keypoint_figure(keypoints, held_out, cache)
        checks = train_keypoint_net(
            *(keypoints, learned, checked, cache, training),
            crops=KeypointCrops(looks=MILD),
            checkpoint=checkpoint,
            progress=progress,
        )
        after = keypoint_figure(keypoints, held_out, cache)
        save_weights(weights, keypoints)
    checkpoint.unlink(missing_ok=True)
    better = after >= before + settings.gain and after > before
    return FineTuned(learned, held_out, before, after, checks[-1].step, better)


def split(
    pictures: Pictures, settings: FineTuningSettings
) -> tuple[list[LabelledPicture], list[LabelledPicture], list[LabelledPicture]]:
    """Return pictures to learn from, to choose by, and to be judged by.

    Raises:
        InputError: a part without anybody.
    """
    count = min(BLOCKS, len(pictures))
    blocks = np.array_split(np.arange(len(pictures)), max(count, 1))
    order = np.random.default_rng([settings.training.seed, 0x5B1]).permutation(len(blocks))
    held = max(round(settings.held_out * count), 1)
    chosen = held + max(round(settings.checked * count), 1)
    parts = []
    for name, places in (
        ("learned from", order[chosen:]),
        ("chosen by", order[held:chosen]),
        ("judged by", order[:held]),
    ):
        part = [pictures[index] for place in sorted(places) for index in blocks[place]]
        if not any((~picture.ignored).any() for picture in part):
            raise InputError(
                "labels",
                expected="people in the pictures that are learned from, chosen by and judged by",
                found=f"none in those {name}, of {len(pictures)} pictures in all",
                todo="Label more pictures; 200 are a good beginning.",
            )
        parts.append(part)
    return parts[0], parts[1], parts[2]
