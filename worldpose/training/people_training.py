"""Windows of frames as training batches of the people net, and its loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from data_contracts.arrays import Floats, Image, Singles
from data_contracts.records import Record
from worldpose.detection.bundled_nets import STRIDE, PeopleNet, normalize
from worldpose.detection.crops import cut_crop, frame_from_crop
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.labels import LabelledPicture, PictureCache


class PeopleWindows(Record):
    """Windows cut from frames."""

    windows: int = 4
    """Windows per batch."""
    side: int = 256
    """Width and height of a window [px], a multiple of 32."""
    height: tuple[float, float] = (28.0, 160.0)
    """Shortest and tallest people after scaling [px]."""
    aimed: float = 0.75
    """Share of windows placed around people [1]; the others lie anywhere."""
    looks: AugmentationSettings = AugmentationSettings()


@dataclass(frozen=True, eq=False)
class PeopleBatch:
    """Windows and the targets of the net.

    Attributes:
        pictures: (windows, side, side, 3) bytes.
        target: (windows, rows, columns) in [0, 1]; 1 at the cell of a centre.
        weight: (windows, rows, columns), 0 on ignored people.
        boxes: (windows, 4, rows, columns) [px] of the person that a cell belongs to.
    """

    pictures: Image
    target: Singles
    weight: Singles
    boxes: Singles


def people_batch(
    pictures: Sequence[LabelledPicture],
    cache: PictureCache,
    settings: PeopleWindows,
    rng: np.random.Generator,
) -> PeopleBatch:
    """Return a batch; the same generator gives the same one."""
    side, cells = settings.side, settings.side // STRIDE
    seen = np.empty((settings.windows, side, side, 3), dtype=np.uint8)
    target = np.zeros((settings.windows, cells, cells), dtype=np.float32)
    weight = np.ones_like(target)
    boxes = np.zeros((settings.windows, 4, cells, cells), dtype=np.float32)
    for index in range(settings.windows):
        labelled = pictures[int(rng.integers(len(pictures)))]
        picture = cache[labelled.path]
        crop = _window(labelled, picture.shape, settings, rng)
        mapping = frame_from_crop(crop, (side, side), 0.0, bool(rng.random() < 0.5))
        inside, ignored = boxes_in_window(labelled, picture.shape, mapping, side)
        cut = cut_crop(picture, mapping, (side, side))
        cut = settings.looks.add_things(cut, np.concatenate([inside, ignored]), rng)
        seen[index] = settings.looks.augment(cut, rng)
        draw_targets(inside, ignored, target[index], weight[index], boxes[index])
    return PeopleBatch(seen, target, weight, boxes)


def _window(
    labelled: LabelledPicture,
    shape: tuple[int, ...],
    settings: PeopleWindows,
    rng: np.random.Generator,
) -> Floats:
    """Return centre x, y [px] and image px per window px of a random window."""
    tall = np.exp(rng.uniform(*np.log(settings.height)))
    wanted = np.flatnonzero(~labelled.ignored)
    sides = labelled.boxes[:, 2:] - labelled.boxes[:, :2]
    if len(wanted):
        person = int(rng.choice(wanted))
        scale = float(np.clip(sides[person].max() / tall, 0.3, 3.0))
        if rng.random() < settings.aimed:
            middle = labelled.boxes[person].reshape(2, 2).mean(axis=0)
            reach = 0.45 * settings.side * scale
            return np.array([*(middle + rng.uniform(-reach, reach, 2)), scale])
    else:
        scale = float(np.exp(rng.uniform(np.log(0.4), np.log(2.0))))
    return np.array([rng.uniform(0, shape[1]), rng.uniform(0, shape[0]), scale])


def boxes_in_window(
    labelled: LabelledPicture, shape: tuple[int, ...], mapping: Floats, side: int
) -> tuple[Floats, Floats]:
    """Return boxes of target people in a window (n, 4), and of ignored ones (m, 4) [px]."""
    inverse = np.linalg.inv(mapping[:, :2])
    corners = (labelled.boxes.reshape(-1, 2, 2) - mapping[:, 2]) @ inverse.T
    limits = (np.array([[0.0, 0.0], [shape[1], shape[0]]]) - 0.5 - mapping[:, 2]) @ inverse.T
    low = np.maximum(limits.min(axis=0), -0.5)
    high = np.minimum(limits.max(axis=0), side - 0.5)
    whole = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    clipped = np.concatenate(
        [np.clip(whole[:, :2], low, high), np.clip(whole[:, 2:], low, high)], 1
    )
    area = np.prod(whole[:, 2:] - whole[:, :2], axis=1)
    share = np.prod(clipped[:, 2:] - clipped[:, :2], axis=1) / np.maximum(area, 1e-9)
    there = share > 0.0
    # Share of a box within a window from which on the person is a target [1].
    wanted = (share >= 0.3) & ~labelled.ignored
    return clipped[there & wanted], clipped[there & ~wanted]


def draw_targets(
    boxes: Floats, ignored: Floats, target: Singles, weight: Singles, sides: Singles
) -> None:
    """Write one window's target, weight and boxes, in place."""
    middles = np.arange(target.shape[0]) * STRIDE + 0.5 * (STRIDE - 1)
    for x0, y0, x1, y1 in ignored:
        rows, columns = (middles >= y0) & (middles <= y1), (middles >= x0) & (middles <= x1)
        weight[np.ix_(rows, columns)] = 0.0
    for box in boxes:
        x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
        # Standard deviation of the target around a centre, as a share of the box's sides [1].
        spread = np.maximum(0.12 * (box[2:] - box[:2]), 0.5 * STRIDE)
        across = np.exp(-0.5 * ((middles - x) / spread[0]) ** 2)
        down = np.exp(-0.5 * ((middles - y) / spread[1]) ** 2)
        bump = np.asarray(down[:, None] * across[None, :], dtype=np.float32)
        row, column = (int(np.abs(middles - value).argmin()) for value in (y, x))
        bump[row, column] = 1.0
        mine = bump > target
        target[mine] = bump[mine]
        sides[:, mine] = box[:, None]
        weight[row, column] = 1.0


def people_loss(net: PeopleNet, batch: PeopleBatch) -> Tensor:
    """Return the loss of the net's maps against the batch's truth.

    Centres: penalty-reduced focal loss (Zhou, Objects as Points, 2019). Boxes: generalised
    intersection over union (Rezatofighi, 2019) at the cells around a centre.
    """
    device = next(net.parameters()).device
    target, weight, boxes = (
        torch.from_numpy(each).to(device) for each in (batch.target, batch.weight, batch.boxes)
    )
    logits, sides = net(normalize(torch.from_numpy(batch.pictures).to(device)))
    chance = torch.sigmoid(logits)
    found = (1.0 - chance).square() * functional.logsigmoid(logits)
    empty = (1.0 - target) ** 4 * chance.square() * functional.logsigmoid(-logits)
    middle = target == 1.0
    people = middle.sum().clamp(min=1)
    focal = -(weight * torch.where(middle, found, empty)).sum() / people
    # Cells with a target from this value on learn the box's sides [1].
    near = torch.where(target >= 0.5, target, 0.0)
    y, x = (
        torch.arange(count, device=device) * STRIDE + 0.5 * (STRIDE - 1)
        for count in sides.shape[2:]
    )
    y = y[:, None]
    said = torch.stack([x - sides[:, 0], y - sides[:, 1], x + sides[:, 2], y + sides[:, 3]], dim=-1)
    _, overlap = box_overlap(said, boxes.movedim(1, -1))
    # Weight of the box loss, relative to that of the centres [1]: centres are learned sooner.
    return focal + 4.0 * (near * (1.0 - overlap)).sum() / near.sum().clamp(min=1.0)


def box_overlap(said: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Return intersection over union [1] of boxes, and the generalised one, which falls below 0.

    Boxes are (..., 4) x0, y0, x1, y1 [px], and broadcast.
    """
    low, high = (
        torch.maximum(said[..., :2], true[..., :2]),
        torch.minimum(said[..., 2:], true[..., 2:]),
    )
    first, last = (
        torch.minimum(said[..., :2], true[..., :2]),
        torch.maximum(said[..., 2:], true[..., 2:]),
    )
    both = (high - low).clamp(min=0).prod(dim=-1)
    hull = (last - first).clamp(min=0).prod(dim=-1) + 1e-6
    area = (said[..., 2:] - said[..., :2]).clamp(min=0).prod(dim=-1)
    union = area + (true[..., 2:] - true[..., :2]).prod(dim=-1) - both + 1e-6
    return both / union, both / union - (hull - union) / hull
