"""Trains the net of landmarks that ships with the project, on rendered scenes; scores it.

    python infra/embedded_detector/landmarks.py FOLDER [--share 1.0] [scenes train score]

The net begins with the features of the shipped keypoint net. Weights, checkpoints and
landmark_scores.json end in FOLDER; with another torch their bytes differ, but metrics are similar.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from landmark_labels import read_landmarks, render_landmarks
from numpy.typing import NDArray
from real_looks import RealLooks
from scenes import CHECKING, CROWDS, HELD_OUT, TRAINING, VARIETY
from torch import Tensor
from torch.nn import functional

from worldpose.detection.bundled_nets import (
    CELL,
    KeypointNet,
    load_weights,
    normalize,
    save_weights,
)
from worldpose.detection.landmark_net import POINTS, LandmarkNet, SeenLandmarks, locate
from worldpose.detection.models import BUNDLED_WEIGHTS
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.fine_tuning import MIN_HEIGHT, Training, train
from worldpose.training.keypoint_training import (
    HIDDEN_WEIGHT,
    SPREAD,
    KeypointBatch,
    KeypointCrops,
    keypoint_batch,
    labelled_people,
)
from worldpose.training.labels import LabelledPicture, PictureCache
from worldpose.training.settings import TrainingSettings

SCENES: Final = {
    "training": (TRAINING, 50, 3, 4),
    "variety": (VARIETY, 40, 1, 4),
    "crowds": (CROWDS, 30, 2, 3),
    "checking": (CHECKING, 8, 3, 2),
    "held_out": (HELD_OUT, 10, 3, 3),
}
"""Kind, scenes, views of each and moments of each view."""
CROPS: Final = KeypointCrops(elsewhere=0.0, looks=RealLooks())
"""Crops of people, with the image formation of real cameras."""
PHASES: Final = tuple(
    TrainingSettings(steps=steps, check_every=400, keep="last", rate=rate, seed=seed, bfloat16=True)
    for steps, rate, seed in ((2400, 1e-3, 21), (2000, 8e-4, 22))
)
"""Phases of the shipped weights, each from those of the one before; of the first, 1200 steps were
those of a training planned for 3600."""
TAIL: Final = 4.0
"""Degrees of freedom of the errors' distribution (Student's t): gross errors hardly change the
standard deviation of the others."""
FLIP: Final = tuple(
    POINTS.index(
        point.replace("left_", "right_") if "left_" in point else point.replace("right_", "left_")
    )
    for point in POINTS
)
"""Number of each point's mirror image."""


def landmark_loss(net: LandmarkNet, batch: KeypointBatch) -> Tensor:
    """Return the loss of the net's maps, standard deviations and visibilities.

    Positions: cross-entropy of each map against a narrow Gaussian. Standard deviations: negative
    logarithm of the density of a Student's t. Visibility: cross-entropy.
    """
    keypoints, visible = (torch.from_numpy(each) for each in (batch.keypoints, batch.visible))
    around = torch.from_numpy(batch.surroundings)
    seen: SeenLandmarks = net(normalize(torch.from_numpy(batch.crops)), around)
    maps = seen.maps.contiguous()
    rows, columns = maps.shape[-2:]
    labelled = (visible > 0) & torch.isfinite(keypoints).all(dim=-1)
    at = torch.where(labelled[..., None], keypoints, 0.0)
    near, share = _target_cells(at, (rows, columns))
    # Points outside of the crop leave no peak: there is no position to learn.
    mass = share.sum(dim=-1)
    inside = labelled & (mass > 0.9)
    flat = maps.flatten(2)
    entropy = torch.logsumexp(flat, -1) - (share * flat.gather(-1, near)).sum(-1)
    weight = torch.where(visible == 2, 1.0, HIDDEN_WEIGHT) * inside
    place: Tensor = (weight * entropy).sum() / weight.sum().clamp(min=1.0)

    with torch.no_grad():
        said, extent = locate(maps)
        square = (said - at).square().sum(dim=-1)
    log_std = seen.doubt + seen.trust * extent
    tail = 0.5 * (TAIL + 2.0) * torch.log1p(square / TAIL * torch.exp(-2.0 * log_std))
    spread = ((tail + 2.0 * log_std) * inside).sum() / inside.sum().clamp(min=1)
    shown = functional.binary_cross_entropy_with_logits(
        seen.visible, (visible == 2).float(), reduction="none"
    )
    return place + 0.3 * spread + (shown * labelled).sum() / labelled.sum().clamp(min=1)


def _target_cells(at: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return the 7 x 7 cells around positions, and the shares of a narrow Gaussian in them.

    Args:
        at: (batch, points, 2) [px of the crop].
        size: rows, columns of the maps.

    Returns:
        Numbers of the cells (batch, points, 49), and shares with sum 1 (batch, points, 49), less
        where a part of the Gaussian lies outside of the map.
    """
    rows, columns = size
    cell = (at - 0.5 * (CELL - 1)) / CELL
    steps = torch.arange(-3, 4)
    places = cell.round()[..., None].long() + steps
    share = torch.exp(-0.5 * ((places - cell[..., None]) * CELL / SPREAD).square())
    share = share / share.sum(dim=-1, keepdim=True)
    limit = torch.tensor([columns, rows])[:, None]
    share = share * ((places >= 0) & (places < limit))
    places = places.clamp(min=0).minimum(limit - 1)
    near = places[..., 1, :, None] * columns + places[..., 0, None, :]
    return near.flatten(2), (share[..., 1, :, None] * share[..., 0, None, :]).flatten(2)


def begin_with_keypoint_net() -> LandmarkNet:
    """Return a net with the shipped keypoint net's features, and untrained heads."""
    shipped = load_weights(BUNDLED_WEIGHTS[1], KeypointNet()).state_dict()
    torch.manual_seed(PHASES[0].seed)
    net = LandmarkNet()
    own = net.state_dict()
    kept = {
        name: value
        for name, value in shipped.items()
        if name.partition(".")[0] in ("pyramid", "around") and own[name].shape == value.shape
    }
    net.load_state_dict({**own, **kept})
    net.train()
    return net


@torch.inference_mode()
def judge(
    net: LandmarkNet, pictures: Sequence[LabelledPicture], cache: PictureCache, crops: int
) -> dict[str, NDArray[Any]]:
    """Return errors, standard deviations and visibilities of people in slightly wrong boxes.

    Args:
        net: trained.
        pictures: with landmarks.
        cache: of their images.
        crops: number of people, drawn with a fixed seed.

    Returns:
        `error` (crops, points, 2) and `std` (crops, points) [shares of the person's longer side],
        `visible` (crops, points) as labelled and `said` [1].
    """
    people = labelled_people(pictures, MIN_HEIGHT)
    none = ("strength", "recoloured", "grey", "fog", "soft", "coded", "grain")
    plain = KeypointCrops(
        elsewhere=0.0,
        astray=0.0,
        turned=0.0,
        smaller=0.0,
        hidden=0.0,
        imagined=0.0,
        untold=0.0,
        looks=AugmentationSettings(**dict.fromkeys(none, 0.0)),
    )
    net = net.eval()
    found: list[tuple[NDArray[Any], ...]] = []
    for number in range(math.ceil(crops / plain.crops)):
        rng = np.random.default_rng([7, number])
        batch = keypoint_batch(people, cache, plain, rng, FLIP)
        around = torch.from_numpy(batch.surroundings)
        seen = net(normalize(torch.from_numpy(batch.crops)), around)
        places, std = (each.numpy() for each in seen.decode())
        longer = 20.0 * batch.tolerance[:, None]
        error = (places - batch.keypoints) / longer[..., None]
        error[batch.visible == 0] = np.nan
        found.append((error, std / longer, batch.visible, torch.sigmoid(seen.visible).numpy()))
    return dict(
        zip(("error", "std", "visible", "said"), map(np.concatenate, zip(*found, strict=True)),
            strict=True)
    )  # fmt: skip


def summarize(judged: dict[str, NDArray[Any]]) -> dict[str, float]:
    """Return metrics: errors in percent of the person's longer side, and calibration."""
    error, std, visible, said = (judged[k] for k in ("error", "std", "visible", "said"))
    away = np.linalg.norm(error, axis=-1)
    shown, there = visible == 2, np.isfinite(away)
    square = away**2 / std**2
    return {
        "median_error_visible": 100.0 * float(np.median(away[shown & there])),
        "median_error_hidden": 100.0 * float(np.median(away[~shown & there])),
        "mean_error_visible": 100.0 * float(away[shown & there].mean()),
        "within_twentieth_visible": float((away[shown & there] < 0.05).mean()),
        "within_twentieth_hidden": float((away[~shown & there] < 0.05).mean()),
        "in_68_visible": float((square[shown & there] < 2.28).mean()),
        "in_95_visible": float((square[shown & there] < 5.99).mean()),
        "in_68_hidden": float((square[~shown & there] < 2.28).mean()),
        "in_95_hidden": float((square[~shown & there] < 5.99).mean()),
        "visible_right": float(((said > 0.5) == shown)[there].mean()),
        "visible_share": float(shown[there].mean()),
    }


def main(folder: Path, parts: Sequence[str], share: float) -> None:
    """Run the named parts: `scenes`, `train`, `score`.

    Args:
        folder: of all outputs.
        parts: parts to run.
        share: of scenes and steps [1]; less than 1 is a smoke test only.
    """
    torch.set_num_threads(1)
    if "scenes" in parts:
        for name, (kind, count, views, frames) in SCENES.items():
            scenes = max(round(share * count), 1)
            for line in render_landmarks(folder / name, kind, scenes, views=views, frames=frames):
                say(line)
    cache = PictureCache(6 << 30)
    weights = folder / "embedded_landmarks.safetensors"
    if "train" in parts:
        train_phases(folder, cache, share)
    if "score" in parts:
        net = load_weights(weights, LandmarkNet())
        figures = summarize(judge(net, read_landmarks(folder / "held_out"), cache, 3200))
        (folder / "landmark_scores.json").write_text(json.dumps(figures, indent=2) + "\n")
        say(json.dumps(figures))


def train_phases(folder: Path, cache: PictureCache, share: float) -> None:
    """Train a net through its phases; finished ones are read."""
    sets = ("training", "variety", "crowds")
    learned = [picture for name in sets for picture in read_landmarks(folder / name)]
    people, checked = labelled_people(learned, MIN_HEIGHT), read_landmarks(folder / "checking")

    def score(mean: LandmarkNet) -> float:
        figures = summarize(judge(mean, checked, cache, 320))
        say(json.dumps({name: round(value, 3) for name, value in figures.items()}))
        return -figures["mean_error_visible"]

    net = begin_with_keypoint_net()
    for number, phase in enumerate(PHASES):
        done = folder / f"landmarks-{number}.safetensors"
        if not done.exists():
            each = {name: getattr(phase, name) for name in ("steps", "check_every")}
            settings = phase.model_copy(
                update={name: max(round(share * count), 1) for name, count in each.items()}
            )
            net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
            training = Training(
                net,
                lambda rng: keypoint_batch(people, cache, CROPS, rng, FLIP),
                landmark_loss,
                score,
                settings,
            )
            train(training, done.with_suffix(".checkpoint"), say)
            save_weights(done, net, {"trained-on": "rendered scenes", "seed": str(settings.seed)})
        net = load_weights(done, LandmarkNet())
    state_errors(net, judge(net, checked, cache, 1600))
    about = {"trained-on": "rendered scenes", "seed": str(PHASES[-1].seed)}
    save_weights(folder / "embedded_landmarks.safetensors", net, about)


def state_errors(net: LandmarkNet, judged: dict[str, NDArray[Any]]) -> None:
    """Scale the stated standard deviations so that 95 % regions contain 95 %, in place.

    Args:
        net: trained; the training states the errors of its own crops, which are smaller.
        judged: result of `judge` for images that it was not trained on.
    """
    away = np.linalg.norm(judged["error"], axis=-1) / judged["std"]
    high = np.nanquantile(away, 0.95, axis=0) / math.sqrt(5.99)
    say(f"standard deviations times {np.median(high):.2f} ({high.min():.2f} to {high.max():.2f})")
    with torch.no_grad():
        net.doubt.bias.add_(torch.from_numpy(np.log(high)).float())


def say(line: str) -> None:
    """Print a line with the processor time so far."""
    print(f"{time.process_time():7.0f} s  {line}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", default=["scenes", "train", "score"])
    parser.add_argument("--share", type=float, default=1.0)
    given = parser.parse_args()
    main(given.folder, given.parts, given.share)
