"""Training and scoring of each of the two embedded nets."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import torch

from worldpose.detection.bundled import EmbeddedDetector, EmbeddedPose
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet
from worldpose.training.keypoint_training import (
    KeypointCrops,
    keypoint_batch,
    keypoint_loss,
    people_of,
)
from worldpose.training.labels import LabelledPicture
from worldpose.training.loop import Check, Training, train
from worldpose.training.people_training import PeopleWindows, people_batch, people_loss
from worldpose.training.pictures import PictureCache
from worldpose.training.scoring import found_people, score_keypoints, score_people
from worldpose.training.settings import TrainingSettings

Pictures = Sequence[LabelledPicture]
Progress = Callable[[str], None]

LEAST_HEIGHT: Final = 34.0
"""Shortest person for training and scoring of the keypoint net [px]: limbs are 2 px wide."""


def people_figure(net: PeopleNet, pictures: Pictures, cache: PictureCache) -> float:
    """Return AP50 [1] of a detector."""
    found = found_people(EmbeddedDetector(copy.deepcopy(net)), pictures, cache)
    return score_people(found, pictures)[0]


def keypoint_figure(net: KeypointNet, pictures: Pictures, cache: PictureCache) -> float:
    """Return the share of visible keypoints [1] that a pose estimator puts within 0.2 torsos."""
    estimator = EmbeddedPose(copy.deepcopy(net))
    return score_keypoints(estimator, pictures, cache, (LEAST_HEIGHT, float("inf"))).pck


def train_people_net(
    net: PeopleNet,
    learned: Pictures,
    checked: Pictures,
    cache: PictureCache,
    settings: TrainingSettings,
    *,
    windows: PeopleWindows | None = None,
    checkpoint: Path | None = None,
    progress: Progress = lambda line: None,
) -> tuple[Check, ...]:
    """Train a detector in place; arguments and result are those of `loop.train`."""
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    cut = windows or PeopleWindows()
    training = Training(
        net,
        lambda rng: people_batch(learned, cache, cut, rng),
        people_loss,
        lambda net: people_figure(net, checked, cache),
        settings,
    )
    return train(training, checkpoint, progress)


def train_keypoint_net(
    net: KeypointNet,
    learned: Pictures,
    checked: Pictures,
    cache: PictureCache,
    settings: TrainingSettings,
    *,
    crops: KeypointCrops | None = None,
    checkpoint: Path | None = None,
    progress: Progress = lambda line: None,
) -> tuple[Check, ...]:
    """Train a pose estimator in place; arguments and result are those of `loop.train`."""
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    cut, people = crops or KeypointCrops(), people_of(learned, LEAST_HEIGHT)
    training = Training(
        net,
        lambda rng: keypoint_batch(people, cache, cut, rng),
        keypoint_loss,
        lambda net: keypoint_figure(net, checked, cache),
        settings,
    )
    return train(training, checkpoint, progress)
