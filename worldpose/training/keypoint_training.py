"""What the keypoint net learns from: crops of people, and how far its maps are from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from data_contracts.conventions import COCO17
from data_contracts.records import Record
from worldpose.detection.boxes import overlaps
from worldpose.detection.bundled_crops import crops_of_boxes, cut, picture_from_crop
from worldpose.detection.bundled_nets import CELL, CROP, KeypointNet, normalised, peaks
from worldpose.detection.bundled_surroundings import CELL as AROUND
from worldpose.detection.bundled_surroundings import MAPS, SAME, surroundings
from worldpose.training.augmentation import AugmentationSettings, augment
from worldpose.training.box_overlap import shared
from worldpose.training.labels import LabelledPicture
from worldpose.training.pictures import PictureCache

Floats = NDArray[np.float64]

MIRRORED: Final = np.array(
    [
        COCO17.index(name.replace("left", "*").replace("right", "left").replace("*", "right"))
        for name in COCO17
    ]
)
"""The same joint on the other side."""
SPREAD: Final = 2.0
"""Standard deviation of the target about a joint [px of the crop]."""
HIDDEN: Final = 0.4
"""Weight of a joint that cannot be seen [1]: where it is can be told only by the rest."""
BOXES: Final = 2.0
"""Weight of the box beside that of the joints [1]."""
MOST: Final = 24
"""People that a crop's box may be of, the nearest."""
HALF: Final = 0.5 * (np.array(CROP) - 1.0)
"""The middle of a crop [px of the crop]."""
RIGHT: Final = 0.05
"""A keypoint is right within this share of the box's longer side [1], a fifth of a torso."""


class KeypointCrops(Record):
    """Crops cut around people."""

    crops: int = 16
    """In a batch."""
    height: tuple[float, float] = (34.0, 260.0)
    """People outside of these heights are left out or, above, shown as small [px]."""
    shift: float = 0.08
    """Most that a box is off, as a share of its sides [1]: detectors err."""
    scale: float = 0.18
    """Most that a box is too large or too small [1]."""
    astray: float = 0.3
    """Share of boxes that are off by up to three times as much, and wrong in size by twice [1]."""
    elsewhere: float = 0.12
    """Share of crops put beside people, where a detector may see what is nobody [1]."""
    turned: float = 0.5
    """Share of crops that are turned [1]; of the others the box is learned."""
    turn: float = 0.45
    """Most that a crop is turned [rad]."""
    smaller: float = 0.35
    """Share of people shown as if they were farther away, down to the least height [1]."""
    hidden: float = 0.25
    """Share of crops with a part of another person before them [1]."""
    untold: float = 0.4
    """Share of crops of which is not said where others stand [1]: at first nobody knows."""
    overlooked: float = 0.12
    """Share of others who are not told of all the same [1]."""
    misplaced: float = 0.06
    """Most that a side of another's box is off, as a share of the box's [1]."""
    imagined: float = 0.1
    """Share of crops with somebody told of who is not there [1]."""
    looks: AugmentationSettings = AugmentationSettings()


@dataclass(frozen=True, eq=False)
class KeypointBatch:
    """Crops and what the net should say of them.

    Attributes:
        crops: (crops, height, width, 3) bytes.
        surroundings: (crops, 3, rows, columns) who is asked for and who is about.
        keypoints: (crops, 17, 2) [px of the crop]; NaN where not labelled.
        visible: (crops, 17): 2 seen, 1 hidden, 0 not labelled.
        tolerance: (crops,) error up to which a keypoint is right [px of the crop].
        boxes: (crops, 4) of the person [px of the crop]; NaN in a turned crop and beside people.
        people: (crops, most_people, 4) of everybody [px of the crop]; NaN in a turned crop and
            where there is nobody more.
        ignored: (crops, most_people)
    """

    crops: NDArray[np.uint8]
    surroundings: NDArray[np.float32]
    keypoints: NDArray[np.float32]
    visible: NDArray[np.int8]
    tolerance: NDArray[np.float32]
    boxes: NDArray[np.float32]
    people: NDArray[np.float32]
    ignored: NDArray[np.bool_]


def people_of(
    pictures: Sequence[LabelledPicture], least: float = 0.0
) -> list[tuple[LabelledPicture, int]]:
    """Return everybody who is labelled, with at least two joints, and at least so tall [px]."""
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
) -> KeypointBatch:
    """Return a batch; the same generator gives the same one.

    Args:
        people: to draw from, each as often, as of `people_of`.
        cache: reads their pictures.
        settings: number and looks of the crops.
        rng: draws people, errors of boxes and looks.
    """
    count = settings.crops
    crops = np.empty((count, CROP[1], CROP[0], 3), dtype=np.uint8)
    around = np.empty((count, MAPS, *(side // AROUND for side in reversed(CROP))), np.float32)
    keypoints = np.empty((count, 17, 2), dtype=np.float32)
    visible = np.empty((count, 17), dtype=np.int8)
    tolerance = np.empty(count, dtype=np.float32)
    boxes = np.full((count, 4), np.nan, dtype=np.float32)
    everybody = np.full((count, MOST, 4), np.nan, dtype=np.float32)
    ignored = np.zeros((count, MOST), dtype=np.bool_)
    for index in range(count):
        labelled, person = people[int(rng.integers(len(people)))]
        box = labelled.boxes[person]
        sides = box[2:] - box[:2]
        beside = rng.random() < settings.elsewhere
        far = 1.0 + 2.0 * (rng.random() < settings.astray)
        off = settings.shift * far * rng.uniform(-1, 1, 2) * sides
        if beside:
            off = rng.uniform(0.3, 1.6, 2) * rng.choice([-1.0, 1.0], 2) * sides
        middle = 0.5 * (box[:2] + box[2:]) + off
        half = 0.5 * sides * np.exp(settings.scale * (0.5 + 0.5 * far) * rng.uniform(-1, 1))
        given = np.concatenate([middle - half, middle + half])
        crop = crops_of_boxes(given[None], CROP)[0]
        mirrored = bool(rng.random() < 0.5)
        turned = bool(rng.random() < settings.turned)
        turn = settings.turn * rng.uniform(-1, 1) ** 3 if turned else 0.0
        mapping = picture_from_crop(crop, CROP, turn, mirrored)
        others = _told(labelled, -1 if beside else person, given, settings, rng)
        around[index] = surroundings(given, others, mapping, CROP)
        tall = float(sides.max())
        farther = 1.0
        if rng.random() < settings.smaller and tall > settings.height[0]:
            farther = tall / np.exp(rng.uniform(np.log(settings.height[0]), np.log(tall)))
        seen = _seen(cache[labelled.path], mapping, crop[2] / farther)
        order = MIRRORED if mirrored else slice(None)
        pixels = (labelled.keypoints[person][order] - mapping[:, 2]) @ np.linalg.inv(
            mapping[:, :2]
        ).T
        sight = labelled.visible[person][order].copy()
        if beside:
            sight[:] = 0
        if not turned:
            there = boxes_in_crop(labelled.boxes, mapping)
            near = np.argsort(np.abs(there.reshape(-1, 2, 2).mean(axis=1) - HALF).sum(axis=1))
            near = near[:MOST]
            everybody[index, : len(near)] = there[near]
            ignored[index, : len(near)] = labelled.ignored[near]
            boxes[index] = np.nan if beside else there[person]
        if index and rng.random() < settings.hidden:
            _cover(seen, crops[index - 1], pixels, sight, rng)
        crops[index] = augment(seen, settings.looks, rng)
        keypoints[index], visible[index] = pixels, sight
        tolerance[index] = RIGHT * tall / crop[2]
    return KeypointBatch(crops, around, keypoints, visible, tolerance, boxes, everybody, ignored)


def _told(
    labelled: LabelledPicture,
    person: int,
    given: Floats,
    settings: KeypointCrops,
    rng: np.random.Generator,
) -> Floats:
    """Boxes of others (people, 4) that the net is told of, as a detector might have them [px]."""
    untold = rng.random() < settings.untold
    boxes = np.delete(labelled.boxes, [person] if person >= 0 else [], axis=0)
    ignored = np.delete(labelled.ignored, [person] if person >= 0 else [])
    # Who is hardly to be seen is found now and then.
    missing = np.where(ignored, 0.5, settings.overlooked)
    sides = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = boxes + settings.misplaced * rng.uniform(-1, 1, boxes.shape) * sides
    told = boxes[(rng.random(len(boxes)) >= missing) & (overlaps(boxes, given[None])[:, 0] <= SAME)]
    nobody = given + np.tile(rng.uniform(-1, 1, 2) * (given[2:] - given[:2]), 2)
    if rng.random() < settings.imagined and overlaps(nobody[None], given[None])[0, 0] <= SAME:
        told = np.concatenate([told, nobody[None]])
    return np.empty((0, 4)) if untold else told


def boxes_in_crop(boxes: Floats, mapping: Floats) -> Floats:
    """Boxes of a picture (people, 4) in the pixels of an upright crop, mirrored or not."""
    corners = (boxes.reshape(-1, 2, 2) - mapping[:, 2]) @ np.linalg.inv(mapping[:, :2]).T
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def _seen(picture: NDArray[np.uint8], mapping: Floats, scale: float) -> NDArray[np.uint8]:
    """A crop as it is with so many picture px a crop px: from farther away there are fewer."""
    coarse = float(np.sqrt(abs(np.linalg.det(mapping[:, :2])))) / scale
    if coarse <= 1.0:
        return cut(picture, mapping, CROP)
    share = 1.0 / coarse
    width, height = (max(round(side * share), 8) for side in CROP)
    across, down = CROP[0] / width, CROP[1] / height
    grow = np.array([[across, 0.0, 0.5 * (across - 1.0)], [0.0, down, 0.5 * (down - 1.0)]])
    small_map = np.column_stack(
        [mapping[:, :2] @ grow[:, :2], mapping[:, :2] @ grow[:, 2] + mapping[:, 2]]
    )
    small = cut(picture, small_map, (width, height))
    shrink = np.array([[1 / across, 0.0, 0.5 / across - 0.5], [0.0, 1 / down, 0.5 / down - 0.5]])
    return cut(small, shrink, CROP)


def _cover(
    crop: NDArray[np.uint8],
    other: NDArray[np.uint8],
    pixels: Floats,
    visible: NDArray[np.int8],
    rng: np.random.Generator,
) -> None:
    """Put a part of another crop before the person, in place; what it covers is hidden."""
    width, height = int(rng.integers(12, 44)), int(rng.integers(16, 72))
    x, y = int(rng.integers(0, CROP[0] - width)), int(rng.integers(0, CROP[1] - height))
    left, top = (CROP[0] - width) // 2, (CROP[1] - height) // 2
    crop[y : y + height, x : x + width] = other[top : top + height, left : left + width]
    inside = (pixels >= [x, y]) & (pixels < [x + width, y + height])
    visible[inside.all(axis=-1) & (visible == 2)] = 1


def keypoint_loss(net: KeypointNet, batch: KeypointBatch) -> Tensor:
    """Return how far the net's maps and its sureness are from the batch's truth.

    Places by the cross-entropy of each map against a narrow bump, sureness by the cross-entropy of
    whether the place that the map says is right; the box by generalised intersection over union
    (Rezatofighi, 2019), its fit by the cross-entropy of what it shares with anybody's.
    """
    device = next(net.parameters()).device
    keypoints, visible, tolerance = (
        torch.from_numpy(each).to(device)
        for each in (batch.keypoints, batch.visible, batch.tolerance)
    )
    around = torch.from_numpy(batch.surroundings).to(device)
    maps, doubt, box, fit = net(normalised(torch.from_numpy(batch.crops).to(device)), around)
    rows, columns = maps.shape[-2:]
    labelled = (visible > 0) & torch.isfinite(keypoints).all(dim=-1)
    at = torch.where(labelled[..., None], keypoints, 0.0)
    x = torch.arange(columns, device=device) * CELL + 0.5 * (CELL - 1)
    y = torch.arange(rows, device=device) * CELL + 0.5 * (CELL - 1)
    across = torch.exp(-0.5 * ((x - at[..., :1]) / SPREAD) ** 2)
    down = torch.exp(-0.5 * ((y - at[..., 1:]) / SPREAD) ** 2)
    bump = (down[..., :, None] * across[..., None, :]).flatten(2)
    mass = bump.sum(dim=-1)
    # Joints outside of the crop leave no bump: there is no place to learn.
    inside = labelled & (mass > 4.0)
    entropy = torch.logsumexp(maps.flatten(2), -1)
    entropy = entropy - (bump * maps.flatten(2)).sum(-1) / mass.clamp(min=1e-6)
    weight = torch.where(visible == 2, 1.0, HIDDEN) * inside
    place: Tensor = (weight * entropy).sum() / weight.sum().clamp(min=1.0)

    with torch.no_grad():
        said, near = peaks(maps)
        right = (torch.linalg.norm(said - at, dim=-1) <= tolerance[:, None]) & inside
    sure = functional.binary_cross_entropy_with_logits(
        net.sureness(doubt, near), right.float(), reduction="none"
    )
    doubt_loss: Tensor = (sure * labelled).sum() / labelled.sum().clamp(min=1)
    return place + doubt_loss + box_loss(batch, box, fit)


def box_loss(batch: KeypointBatch, said: Tensor, fit: Tensor) -> Tensor:
    """How far boxes are from the batch's, and their fit from what they share with anybody's.

    Args:
        batch: the truth.
        said: (crops, 4) [px of the crop].
        fit: (crops,) logits.
    """
    boxes, people, ignored = (
        torch.from_numpy(each).to(said.device)
        for each in (batch.boxes, batch.people, batch.ignored)
    )
    mine = torch.isfinite(boxes).all(dim=-1)
    _, general = shared(said, torch.where(mine[:, None], boxes, said.detach()))
    off = (mine * (1.0 - general)).sum() / mine.sum().clamp(min=1)
    with torch.no_grad():
        there = torch.isfinite(people).all(dim=-1)
        overlap, _ = shared(said[:, None], torch.nan_to_num(people))
        overlap = torch.where(there, overlap, 0.0)
        best = overlap.argmax(dim=1, keepdim=True)
        counted = there.any(dim=1) & ~ignored.gather(1, best)[:, 0]
        share = overlap.gather(1, best)[:, 0].clamp(0.0, 1.0)
    expected = functional.binary_cross_entropy_with_logits(fit, share, reduction="none")
    return BOXES * off + (counted * expected).sum() / counted.sum().clamp(min=1)
