"""Crops of people as training batches of the keypoint net, and its loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from data_contracts.arrays import Flags, Floats, Image, Singles
from data_contracts.conventions import COCO17_FLIP
from data_contracts.records import Record
from worldpose.detection.bundled_nets import CELL, KeypointNet, Seen, normalize, peaks
from worldpose.detection.bundled_pose import SAME_PERSON_IOU
from worldpose.detection.crops import (
    CROP,
    MAP_CELL,
    MAP_COUNT,
    crops_around,
    cut_crop,
    frame_from_crop,
    surroundings,
)
from worldpose.geometry.boxes import box_iou
from worldpose.training.augmentation import AugmentationSettings
from worldpose.training.labels import LabelledPicture, PictureCache
from worldpose.training.metrics import MAX_ERROR_SHARE
from worldpose.training.people_training import box_overlap

SPREAD: Final = 2.0
"""Standard deviation of the target around a joint [px of the crop]."""
HIDDEN_WEIGHT: Final = 0.4
"""Weight of an occluded joint [1]: only the rest of the body tells its position."""
CROP_CENTER: Final = 0.5 * (np.array(CROP) - 1.0)
"""The centre of a crop [px of the crop]."""


class KeypointCrops(Record):
    """Crops cut around people."""

    crops: int = 16
    """Crops per batch."""
    min_height: float = 34.0
    """Least height of people shown smaller [px]."""
    shift: float = 0.08
    """Largest shift of a box, as a share of its sides [1]: detectors err."""
    scale: float = 0.18
    """Largest relative error of a box's size [1]."""
    astray: float = 0.3
    """Share of boxes with up to three times the shift and twice the error of size [1]."""
    elsewhere: float = 0.12
    """Share of crops next to people, where a detector may report a false positive [1]."""
    turned: float = 0.5
    """Share of rotated crops [1]; the box is learned from the others."""
    turn: float = 0.45
    """Largest rotation of a crop [rad]."""
    smaller: float = 0.35
    """Share of people shown as if they were farther away, down to the least height [1]."""
    hidden: float = 0.25
    """Share of crops with a part of another person pasted over the person [1]."""
    untold: float = 0.4
    """Share of crops without the boxes of neighbours [1]: they are unknown in the first pass."""
    overlooked: float = 0.12
    """Share of neighbours left out nevertheless [1]."""
    misplaced: float = 0.06
    """Largest shift of a side of a neighbour's box, as a share of the box's [1]."""
    imagined: float = 0.1
    """Share of crops with the box of a neighbour that is not there [1]."""
    looks: AugmentationSettings = AugmentationSettings()


@dataclass(frozen=True, eq=False)
class KeypointBatch:
    """Crops and the targets of the net.

    Attributes:
        crops: (crops, height, width, 3) bytes.
        surroundings: (crops, 3, rows, columns) maps of the target box and its neighbours.
        keypoints: (crops, 17, 2) [px of the crop]; NaN where not labelled.
        visible: (crops, 17): 2 visible, 1 occluded, 0 not labelled.
        tolerance: (crops,) error up to which a keypoint is correct [px of the crop].
        boxes: (crops, 4) boxes of the person [px of the crop]; NaN in a rotated crop and off
            people.
        people: (crops, most_people, 4) boxes of all people [px of the crop]; NaN in a rotated crop
            and after the last person.
        ignored: (crops, most_people)
    """

    crops: Image
    surroundings: Singles
    keypoints: Singles
    visible: NDArray[np.int8]
    tolerance: Singles
    boxes: Singles
    people: Singles
    ignored: Flags


def labelled_people(
    pictures: Sequence[LabelledPicture], least: float = 0.0
) -> list[tuple[LabelledPicture, int]]:
    """Return all labelled people with at least two joints and at least `least` tall [px]."""
    return [
        (picture, index)
        for picture in pictures
        for index, box in enumerate(picture.boxes)
        if not picture.ignored[index]
        and (picture.visible[index] > 0).sum() >= 2
        and np.max(box[2:] - box[:2]) >= least
    ]


def keypoint_batch(
    people: Sequence[tuple[LabelledPicture, int]],
    cache: PictureCache,
    settings: KeypointCrops,
    rng: np.random.Generator,
    flip: Sequence[int] = COCO17_FLIP,
) -> KeypointBatch:
    """Return a batch; the same generator gives the same one.

    People of `labelled_people` have equal probability; the generator draws them, errors of boxes
    and augmentations. `flip` (points,) is the number of each point's mirror image, for labels of
    other points than joints.
    """
    count = settings.crops
    crops = np.empty((count, CROP[1], CROP[0], 3), dtype=np.uint8)
    cells = (CROP[1] // MAP_CELL, CROP[0] // MAP_CELL)
    around = np.empty((count, MAP_COUNT, *cells), np.float32)
    keypoints = np.empty((count, len(flip), 2), dtype=np.float32)
    visible = np.empty((count, len(flip)), dtype=np.int8)
    tolerance = np.empty(count, dtype=np.float32)
    boxes = np.full((count, 4), np.nan, dtype=np.float32)
    max_neighbours = 24  # Most people per crop that its box is compared with, the nearest.
    all_boxes = np.full((count, max_neighbours, 4), np.nan, dtype=np.float32)
    ignored = np.zeros((count, max_neighbours), dtype=np.bool_)
    for index in range(count):
        labelled, person = people[int(rng.integers(len(people)))]
        box = labelled.boxes[person]
        sides = box[2:] - box[:2]
        elsewhere = rng.random() < settings.elsewhere
        far = 1.0 + 2.0 * (rng.random() < settings.astray)
        off = settings.shift * far * rng.uniform(-1, 1, 2) * sides
        if elsewhere:
            off = rng.uniform(0.3, 1.6, 2) * rng.choice([-1.0, 1.0], 2) * sides
        middle = 0.5 * (box[:2] + box[2:]) + off
        half = 0.5 * sides * np.exp(settings.scale * (0.5 + 0.5 * far) * rng.uniform(-1, 1))
        given = np.concatenate([middle - half, middle + half])
        crop = crops_around(given[None])[0]
        mirrored = bool(rng.random() < 0.5)
        turned = bool(rng.random() < settings.turned)
        turn = settings.turn * rng.uniform(-1, 1) ** 3 if turned else 0.0
        mapping = frame_from_crop(crop, CROP, turn, mirrored)
        others = _neighbour_boxes(labelled, -1 if elsewhere else person, given, settings, rng)
        around[index] = surroundings(given[None], [others], mapping[None], CROP)[0]
        tall = float(sides.max())
        farther = 1.0
        if rng.random() < settings.smaller and tall > settings.min_height:
            farther = tall / np.exp(rng.uniform(np.log(settings.min_height), np.log(tall)))
        seen = _cut_shrunk(cache[labelled.path], mapping, crop[2] / farther)
        order = np.array(flip) if mirrored else slice(None)
        pixels = (labelled.keypoints[person][order] - mapping[:, 2]) @ np.linalg.inv(
            mapping[:, :2]
        ).T
        sight = labelled.visible[person][order].copy()
        if elsewhere:
            sight[:] = 0
        if not turned:
            there = boxes_in_crop(labelled.boxes, mapping)
            near = np.argsort(
                np.abs(there.reshape(-1, 2, 2).mean(axis=1) - CROP_CENTER).sum(axis=1)
            )
            near = near[:max_neighbours]
            all_boxes[index, : len(near)] = there[near]
            ignored[index, : len(near)] = labelled.ignored[near]
            boxes[index] = np.nan if elsewhere else there[person]
        if index and rng.random() < settings.hidden:
            _cover(seen, crops[index - 1], pixels, sight, rng)
        crops[index] = settings.looks.augment(seen, rng)
        keypoints[index], visible[index] = pixels, sight
        tolerance[index] = MAX_ERROR_SHARE * tall / crop[2]
    return KeypointBatch(crops, around, keypoints, visible, tolerance, boxes, all_boxes, ignored)


def _neighbour_boxes(
    labelled: LabelledPicture,
    person: int,
    given: Floats,
    settings: KeypointCrops,
    rng: np.random.Generator,
) -> Floats:
    """Return boxes of neighbours (people, 4) for the net, as a detector might give them [px]."""
    untold = rng.random() < settings.untold
    boxes = np.delete(labelled.boxes, [person] if person >= 0 else [], axis=0)
    ignored = np.delete(labelled.ignored, [person] if person >= 0 else [])
    # Detectors find barely visible people now and then.
    missing = np.where(ignored, 0.5, settings.overlooked)
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = boxes + settings.misplaced * rng.uniform(-1, 1, boxes.shape) * sides
    is_other = box_iou(boxes, given[None])[:, 0] <= SAME_PERSON_IOU
    told = boxes[(rng.random(len(boxes)) >= missing) & is_other]
    nobody = given + np.tile(rng.uniform(-1, 1, 2) * (given[2:] - given[:2]), 2)
    is_other = box_iou(nobody[None], given[None])[:, 0] <= SAME_PERSON_IOU
    if rng.random() < settings.imagined and is_other[0]:
        told = np.concatenate([told, nobody[None]])
    return np.empty((0, 4)) if untold else told


def boxes_in_crop(boxes: Floats, mapping: Floats) -> Floats:
    """Return boxes of a frame (people, 4) in the pixels of an upright crop, mirrored or not."""
    corners = (boxes.reshape(-1, 2, 2) - mapping[:, 2]) @ np.linalg.inv(mapping[:, :2]).T
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def _cut_shrunk(picture: Image, mapping: Floats, scale: float) -> Image:
    """Return a crop at `scale` frame px per crop px: a person farther away covers fewer px."""
    coarse = float(np.sqrt(abs(np.linalg.det(mapping[:, :2])))) / scale
    if coarse <= 1.0:
        return cut_crop(picture, mapping, CROP)
    share = 1.0 / coarse
    width, height = (max(round(side * share), 8) for side in CROP)
    across, down = CROP[0] / width, CROP[1] / height
    grow = np.array([[across, 0.0, 0.5 * (across - 1.0)], [0.0, down, 0.5 * (down - 1.0)]])
    small_map = np.column_stack(
        [mapping[:, :2] @ grow[:, :2], mapping[:, :2] @ grow[:, 2] + mapping[:, 2]]
    )
    small = cut_crop(picture, small_map, (width, height))
    shrink = np.array([[1 / across, 0.0, 0.5 / across - 0.5], [0.0, 1 / down, 0.5 / down - 0.5]])
    return cut_crop(small, shrink, CROP)


def _cover(
    crop: Image, other: Image, pixels: Floats, visible: NDArray[np.int8], rng: np.random.Generator
) -> None:
    """Put a part of another crop over the person, in place; joints under it become occluded."""
    width, height = int(rng.integers(12, 44)), int(rng.integers(16, 72))
    x, y = int(rng.integers(0, CROP[0] - width)), int(rng.integers(0, CROP[1] - height))
    left, top = (CROP[0] - width) // 2, (CROP[1] - height) // 2
    crop[y : y + height, x : x + width] = other[top : top + height, left : left + width]
    inside = (pixels >= [x, y]) & (pixels < [x + width, y + height])
    visible[inside.all(axis=-1) & (visible == 2)] = 1


def keypoint_loss(net: KeypointNet, batch: KeypointBatch) -> Tensor:
    """Return the loss of the net's maps and confidences against the batch's truth.

    Positions: cross-entropy of each map against a narrow Gaussian. Confidence: cross-entropy of
    whether the map's position is correct. Box: generalised intersection over union (Rezatofighi,
    2019). Fit: cross-entropy of the box's largest overlap with any person's box.
    """
    device = next(net.parameters()).device
    keypoints, visible, tolerance = (
        torch.from_numpy(each).to(device)
        for each in (batch.keypoints, batch.visible, batch.tolerance)
    )
    around = torch.from_numpy(batch.surroundings).to(device)
    seen: Seen = net(normalize(torch.from_numpy(batch.crops).to(device)), around)
    maps = seen.maps
    rows, columns = maps.shape[-2:]
    labelled = (visible > 0) & torch.isfinite(keypoints).all(dim=-1)
    at = torch.where(labelled[..., None], keypoints, 0.0)
    x = torch.arange(columns, device=device) * CELL + 0.5 * (CELL - 1)
    y = torch.arange(rows, device=device) * CELL + 0.5 * (CELL - 1)
    across = torch.exp(-0.5 * ((x - at[..., :1]) / SPREAD) ** 2)
    down = torch.exp(-0.5 * ((y - at[..., 1:]) / SPREAD) ** 2)
    bump = (down[..., :, None] * across[..., None, :]).flatten(2)
    mass = bump.sum(dim=-1)
    # Joints outside of the crop leave no peak: there is no position to learn.
    inside = labelled & (mass > 4.0)
    entropy = torch.logsumexp(maps.flatten(2), -1)
    entropy = entropy - (bump * maps.flatten(2)).sum(-1) / mass.clamp(min=1e-6)
    weight = torch.where(visible == 2, 1.0, HIDDEN_WEIGHT) * inside
    place: Tensor = (weight * entropy).sum() / weight.sum().clamp(min=1.0)

    with torch.no_grad():
        said, near = peaks(maps)
        right = (torch.linalg.norm(said - at, dim=-1) <= tolerance[:, None]) & inside
    sure = functional.binary_cross_entropy_with_logits(
        seen.sureness(near), right.float(), reduction="none"
    )
    doubt_loss: Tensor = (sure * labelled).sum() / labelled.sum().clamp(min=1)
    return place + doubt_loss + box_loss(batch, seen.boxes, seen.fit)


def box_loss(batch: KeypointBatch, said: Tensor, fit: Tensor) -> Tensor:
    """Return the loss of boxes (crops, 4) [px of the crop], and of their fit (crops,) in logits.

    The fit is the expected overlap with any person's box.
    """
    boxes, people, ignored = (
        torch.from_numpy(each).to(said.device)
        for each in (batch.boxes, batch.people, batch.ignored)
    )
    mine = torch.isfinite(boxes).all(dim=-1)
    _, general = box_overlap(said, torch.where(mine[:, None], boxes, said.detach()))
    off = (mine * (1.0 - general)).sum() / mine.sum().clamp(min=1)
    with torch.no_grad():
        there = torch.isfinite(people).all(dim=-1)
        overlap, _ = box_overlap(said[:, None], torch.nan_to_num(people))
        overlap = torch.where(there, overlap, 0.0)
        best = overlap.argmax(dim=1, keepdim=True)
        counted = there.any(dim=1) & ~ignored.gather(1, best)[:, 0]
        share = overlap.gather(1, best)[:, 0].clamp(0.0, 1.0)
    expected = functional.binary_cross_entropy_with_logits(fit, share, reduction="none")
    # Weight of the box loss, relative to that of the joints [1].
    return 2.0 * off + (counted * expected).sum() / counted.sum().clamp(min=1)
