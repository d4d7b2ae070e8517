"""Training of the bundled nets, and fine-tuning on reviewed labels, adopted if better.

Training is seeded, checkpointed, resumable, with early stopping. Checks evaluate and keep the
running mean of the weights (Polyak averaging), which is better at any step than the weights of the
step. The seed and the step's number alone determine the batch of a step. So a training that was
killed and resumes from its checkpoint gives the weights of an uninterrupted one.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from data_contracts.arrays import Flags
from data_contracts.finetune import NetKind
from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import KeypointNet, PeopleNet, load_weights, save_weights
from worldpose.detection.bundled_pose import BundledPoseEstimator
from worldpose.detection.models import BUNDLED_WEIGHTS
from worldpose.errors import InputError
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.keypoint_training import (
    KeypointCrops,
    keypoint_batch,
    keypoint_loss,
    labelled_people,
)
from worldpose.training.labels import LabelledPicture, PictureCache
from worldpose.training.metrics import average_precision, detect_labelled, score_keypoints
from worldpose.training.people_training import PeopleWindows, people_batch, people_loss
from worldpose.training.settings import FineTuningSettings, TrainingSettings

Net = TypeVar("Net", bound=nn.Module)
AnyNet = PeopleNet | KeypointNet
Batch = TypeVar("Batch")
Tensors = dict[str, Tensor]
Pictures = Sequence[LabelledPicture]
Progress = Callable[[str], None]

MIN_HEIGHT: Final = 34.0
"""Shortest person for training and scoring of the keypoint net [px]: limbs are 2 px wide."""


@dataclass(frozen=True)
class Check:
    """Result of a check during training.

    Attributes:
        step: steps done.
        loss: mean since the previous check.
        score: metric of the net on held-out frames; higher is better.
    """

    step: int
    loss: float
    score: float


@dataclass(frozen=True, eq=False)
class _State:
    """State from which a training resumes."""

    mean: Tensors
    step: int = 0
    checks: tuple[Check, ...] = ()
    best: Tensors = field(default_factory=dict)
    losses: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Training(Generic[Net, Batch]):
    """A net, its batches, loss and metric.

    Attributes:
        net: changed in place.
        batch: draws a batch.
        loss: loss of the net on a batch.
        score: metric of the net on held-out frames; higher is better.
        settings: rate, steps and seed.
    """

    net: Net
    batch: Callable[[np.random.Generator], Batch]
    loss: Callable[[Net, Batch], Tensor]
    score: Callable[[Net], float]
    settings: TrainingSettings


def train(
    training: Training[Net, Batch],
    checkpoint: Path | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> tuple[Check, ...]:
    """Train a net and return its checks; the net then has the weights of the best one.

    A check also runs before the first step: training that makes the net worse changes nothing,
    unless the settings keep the last weights. The checkpoint is written at every check; if the file
    exists, training resumes from it, or InputError if it is of another training. `progress`
    receives a line at every check.
    """
    net, settings = training.net, training.settings
    optimizer = torch.optim.AdamW(net.parameters(), lr=settings.rate, weight_decay=settings.decay)
    state = _State(mean=_copy_tensors(net.state_dict()))
    if checkpoint is not None and checkpoint.is_file():
        state = _read(checkpoint, net, optimizer, settings)
        progress(f"resumes after step {state.step}")
    else:
        state = _check(training, state)
    while state.step < settings.steps and not _has_settled(state, settings):
        loss = _step(training, optimizer, state.step)
        _blend(
            state.mean, net.state_dict(), min(settings.memory, (1 + state.step) / (10 + state.step))
        )
        state = replace(state, step=state.step + 1, losses=(*state.losses, loss))
        if state.step % settings.check_every == 0 or state.step == settings.steps:
            state = _check(training, state)
            last = state.checks[-1]
            progress(
                f"step {last.step} of {settings.steps}: loss {last.loss:.4f}, "
                f"held-out score {last.score:.4f}"
            )
            if checkpoint is not None:
                _write(checkpoint, net, optimizer, state, settings)
    net.load_state_dict(state.best)
    net.eval()
    return state.checks


def _step(training: Training[Net, Batch], optimizer: torch.optim.Optimizer, step: int) -> float:
    settings = training.settings
    planned = settings.planned or settings.steps
    # Share of the steps in which the learning rate rises to its full value [1].
    rising = min((step + 1) / max(0.04 * planned, 1.0), 1.0)
    done = min(step / planned, 1.0)
    last_rate = 0.02  # Share of the full rate at the end [1].
    falling = last_rate + (1.0 - last_rate) * 0.5 * (1.0 + math.cos(math.pi * done))
    for group in optimizer.param_groups:
        group["lr"] = settings.rate * rising * falling
    batch = training.batch(np.random.default_rng([settings.seed, step]))
    training.net.train()
    device = next(training.net.parameters()).device.type
    with torch.autocast(device, torch.bfloat16, enabled=settings.bfloat16):
        loss = training.loss(training.net, batch)
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(training.net.parameters(), settings.clip)
    optimizer.step()
    return float(loss.detach())


def _check(training: Training[Net, Batch], state: _State) -> _State:
    """Return the state after one more check."""
    mean = copy.deepcopy(training.net).eval()
    mean.load_state_dict(state.mean)
    score = training.score(mean)
    best = max((check.score for check in state.checks), default=-math.inf)
    kept = score > best or training.settings.keep == "last"
    loss = float(np.mean(state.losses)) if state.losses else math.nan
    return replace(
        state,
        checks=(*state.checks, Check(state.step, loss, score)),
        best=_copy_tensors(state.mean) if kept else state.best,
        losses=(),
    )


def _has_settled(state: _State, settings: TrainingSettings) -> bool:
    scores = [check.score for check in state.checks]
    if settings.keep == "last":
        return False
    return len(scores) - 1 - scores.index(max(scores)) >= settings.patience


@torch.no_grad()
def _blend(mean: Tensors, now: Tensors, kept: float) -> None:
    """Move a running mean towards the current weights, in place; integers are copied."""
    for name, value in now.items():
        if value.is_floating_point():
            mean[name].lerp_(value, 1.0 - kept)
        else:
            mean[name].copy_(value)


def _copy_tensors(tensors: Tensors) -> Tensors:
    return {name: value.detach().clone().contiguous() for name, value in tensors.items()}


def _write(
    path: Path,
    net: nn.Module,
    optimizer: torch.optim.Optimizer,
    state: _State,
    settings: TrainingSettings,
) -> None:
    """Write a checkpoint atomically."""
    tensors = {f"net.{name}": value for name, value in _copy_tensors(net.state_dict()).items()}
    tensors |= {f"mean.{name}": value for name, value in state.mean.items()}
    tensors |= {f"best.{name}": value for name, value in _copy_tensors(state.best).items()}
    for number, moments in optimizer.state_dict()["state"].items():
        tensors |= {
            f"moment.{number}.{name}": value for name, value in _copy_tensors(moments).items()
        }
    about = {
        "settings": settings.model_dump_json(),
        "step": str(state.step),
        "checks": json.dumps([[c.step, c.loss, c.score] for c in state.checks]),
    }
    draft = path.with_suffix(".part")
    draft.write_bytes(save(tensors, about))
    draft.replace(path)


def _read(
    path: Path, net: nn.Module, optimizer: torch.optim.Optimizer, settings: TrainingSettings
) -> _State:
    """Restore weights and moments of a checkpoint in place; return its state, or InputError."""

    def refusal(found: str) -> InputError:
        todo = "Remove the file to train from the start, or use the settings of the checkpoint."
        return InputError(str(path), "a checkpoint of this training", found, todo)

    try:
        with safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise refusal(f"a file that cannot be read ({error})") from error
    if about.get("settings") != settings.model_dump_json():
        raise refusal(f"settings {about.get('settings', 'of something else')}")
    parts: dict[str, Tensors] = {"net": {}, "mean": {}, "best": {}, "moment": {}}
    for name, value in tensors.items():
        kind, _, rest = name.partition(".")
        parts.setdefault(kind, {})[rest] = value
    moments: dict[int, Tensors] = {}
    for name, value in parts["moment"].items():
        number, _, moment = name.partition(".")
        moments.setdefault(int(number), {})[moment] = value
    try:
        net.load_state_dict(parts["net"])
        optimizer.load_state_dict({**optimizer.state_dict(), "state": moments})
        checks = tuple(Check(int(s), float(v), float(f)) for s, v, f in json.loads(about["checks"]))
        return _State(parts["mean"], int(about["step"]), checks, parts["best"])
    except (RuntimeError, ValueError, KeyError) as error:
        raise refusal(f"{type(error).__name__}: {error}") from error


def score_net(net: AnyNet, pictures: Pictures, cache: PictureCache) -> float:
    """Return AP50 [1] of a detector, or a pose net's share of visible keypoints within 0.2 torsos.

    Keypoints are those of people in their true boxes.
    """
    copied = copy.deepcopy(net)
    if isinstance(copied, PeopleNet):
        found = detect_labelled(BundledDetector(copied), pictures, cache)
        return average_precision(found, pictures)
    estimator = BundledPoseEstimator(copied)
    return score_keypoints(estimator, pictures, cache, (MIN_HEIGHT, math.inf)).pck


def train_net(
    net: AnyNet,
    learned: Pictures,
    checked: Pictures,
    cache: PictureCache,
    settings: TrainingSettings,
    cut: PeopleWindows | KeypointCrops | None = None,
    *,
    checkpoint: Path | None = None,
    progress: Progress = lambda line: None,
) -> tuple[Check, ...]:
    """Train a detector or a pose net in place on the windows or crops that `cut` describes.

    Arguments and result are otherwise those of `train`.
    """
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    batch: Callable[[np.random.Generator], Any]
    loss: Callable[[Any, Any], Tensor]
    if isinstance(net, PeopleNet):
        windows = cut if isinstance(cut, PeopleWindows) else PeopleWindows()
        batch, loss = lambda rng: people_batch(learned, cache, windows, rng), people_loss
    else:
        crops = cut if isinstance(cut, KeypointCrops) else KeypointCrops()
        people = labelled_people(learned, MIN_HEIGHT)
        batch, loss = lambda rng: keypoint_batch(people, cache, crops, rng), keypoint_loss
    score = partial(score_net, pictures=checked, cache=cache)
    training = Training[Any, Any](net, batch, loss, score, settings)
    return train(training, checkpoint, progress)


NET_METRICS: dict[NetKind, str] = {"people": "ap50", "keypoints": "pck"}
"""Metric of each net: AP50 of boxes, share of keypoints within 0.2 torsos."""
MILD = AugmentationSettings(
    strength=0.4, recoloured=0.1, grey=0.0, fog=0.0, soft=0.1, coded=0.1, grain=0.3
)
"""Augmentation for fine-tuning, mild: the labelled frames already show the footage that a version
is for, so air, light and kits of other footage are not needed."""


@dataclass(frozen=True, eq=False)
class FineTuned:
    """Result of fine-tuning.

    Attributes:
        learned: frames in the training set.
        held_out: frames in the test set.
        before: metric of the initial weights [1]; after: that of the final weights.
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

    Images with reviewed labels are in the order of recording. With the checkpoint next to the file
    of weights a killed training resumes. Weights to `start` from, None = shipped ones, are of such
    a net. InputError for too few frames, a subset without people, or weights of another net.
    """
    settings = settings or FineTuningSettings()
    learned, checked, held_out = split(pictures, settings, kind)
    cache, training = PictureCache(), settings.training
    checkpoint = weights.with_suffix(".checkpoint")
    torch.manual_seed(training.seed)
    net: AnyNet = PeopleNet() if kind == "people" else KeypointNet()
    shipped = BUNDLED_WEIGHTS[0 if kind == "people" else 1]
    cut = PeopleWindows(looks=MILD) if kind == "people" else KeypointCrops(looks=MILD)
    load_weights(start or shipped, net)
    before = score_net(net, held_out, cache)
    checks = train_net(
        net, learned, checked, cache, training, cut, checkpoint=checkpoint, progress=progress
    )
    after = score_net(net, held_out, cache)
    save_weights(weights, net)
    checkpoint.unlink(missing_ok=True)
    better = after >= before + settings.gain and after > before
    return FineTuned(learned, held_out, before, after, checks[-1].step, better)


def split(
    pictures: Pictures, settings: FineTuningSettings, kind: NetKind = "people"
) -> tuple[list[LabelledPicture], list[LabelledPicture], list[LabelledPicture]]:
    """Return frames for training, validation, test; InputError for one without measured people."""
    people = "people"
    if kind == "keypoints":
        people += f" of {MIN_HEIGHT:g} px or more with a labelled torso and visible keypoints"
    # Blocks of consecutive frames that stay together: neighbours in a video are almost the same.
    count = min(20, len(pictures))
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
        if not any(_is_measured(picture, kind).any() for picture in part):
            raise InputError(
                "labels",
                expected=f"{people}, in the images for training, for validation and for the test",
                found=f"none in the images for {name}, of {len(pictures)} images in all",
                todo="Label more images; 200 are a good start.",
            )
        parts.append(part)
    return parts[0], parts[1], parts[2]


def _is_measured(picture: LabelledPicture, kind: NetKind) -> Flags:
    """Return (people,) whether the metric of a net counts them."""
    if kind == "people":
        return ~picture.ignored
    tall = picture.boxes[:, 3] - picture.boxes[:, 1] >= MIN_HEIGHT
    torso = (picture.visible[:, [5, 6, 11, 12]] > 0).all(-1)
    return np.asarray(~picture.ignored & tall & torso & (picture.visible == 2).any(-1))
