"""Crops of people, as nets take them, with maps of the people around."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Final

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image, Singles

CROP: Final = (96, 128)
"""Width, height of the crops that the bundled nets take [px]."""
MAP_COUNT: Final = 3
"""The target box, boxes of people in front of the target, and of people behind it: maps that the
keypoint net takes with a crop."""
MAP_CELL: Final = 4
"""Pixels of the crop per cell of the maps of boxes [px]."""
OUTSIDE: Final = 115
"""Grey level outside of a frame [of 255]."""


def crops_around(boxes: Floats, size: tuple[int, int] = CROP) -> Floats:
    """Return the crops (people, 3) that show boxes whole: centre x, y [px], frame px per crop px.

    Boxes are (people, 4) x0, y0, x1, y1 [px], the size of crops is width, height [px].
    """
    sides = boxes[:, 2:] - boxes[:, :2]
    # Size of a crop over that of its box [1]: keypoints may lie outside of a box.
    scale = 1.25 * np.max(sides / np.array(size), axis=1)
    middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    return np.column_stack([middle, np.maximum(scale, 1e-3)])


def frame_from_crop(
    crop: Floats, size: tuple[int, int], turn: float = 0.0, mirrored: bool = False
) -> Floats:
    """Return the affine maps (..., 2, 3) from pixels of crops to pixels of the frame.

    Crops (..., 3) of `crops_around` have a size, width, height [px], and a turn within the frame,
    from x to y [rad]; `mirrored` ones are so left to right.
    """
    cos, sin = np.cos(turn), np.sin(turn)
    linear = crop[..., 2, None, None] * np.array([[cos, -sin], [sin, cos]])
    if mirrored:
        linear[..., 0] *= -1.0
    middle = 0.5 * (np.array(size) - 1.0)
    return np.concatenate([linear, (crop[..., :2] - linear @ middle)[..., None]], axis=-1)


def cut_crop(image: Image, mapping: Floats, size: tuple[int, int], outside: int = OUTSIDE) -> Image:
    """Return a crop (height, width, 3) of an image, grey `outside` of the frame [of 255].

    The mapping (2, 3) is affine, from pixels of the crop of a width, height [px] to those of the
    frame.
    """
    shrink = float(_scale(mapping))
    if shrink > 2.0:
        # Bilinear interpolation alone would skip pixels.
        image, mapping = _shrink(image, mapping, int(shrink), size)
    return np.asarray(
        cv2.warpAffine(
            image,
            mapping,
            size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(outside, outside, outside),
        ),
        dtype=np.uint8,
    )


def _shrink(
    image: Image, mapping: Floats, factor: int, size: tuple[int, int]
) -> tuple[Image, Floats]:
    """Return the part of a frame that a crop shows, shrunk by a whole number, and its map."""
    corners = np.array([[0.0, 0.0], [size[0], 0.0], [0.0, size[1]], [*size]])
    seen = corners @ mapping[:, :2].T + mapping[:, 2]
    high = np.array([image.shape[1], image.shape[0]])
    low = np.clip(np.floor(seen.min(axis=0)) - factor, 0, high - 1).astype(int)
    end = np.clip(np.ceil(seen.max(axis=0)) + factor, low + 1, high).astype(int)
    cells = -(-(end - low) // factor)
    part = image[low[1] : end[1], low[0] : end[0]]
    if part.shape[1] < factor or part.shape[0] < factor:
        return part, np.column_stack([mapping[:, :2], mapping[:, 2] - low])
    below, right = cells[::-1] * factor - part.shape[:2]
    whole = np.pad(part, ((0, below), (0, right), (0, 0)), mode="edge")
    small = np.asarray(cv2.resize(whole, cells.tolist(), interpolation=cv2.INTER_AREA), np.uint8)
    moved = (mapping[:, 2] - low - 0.5 * (factor - 1)) / factor
    return small, np.column_stack([mapping[:, :2] / factor, moved])


def _scale(mapping: Floats) -> Floats:
    """Return the frame px per crop px of maps (..., 2, 3)."""
    straight = mapping[..., 0, 0] * mapping[..., 1, 1]
    return np.asarray(np.sqrt(np.abs(straight - mapping[..., 0, 1] * mapping[..., 1, 0])))


def surroundings(
    boxes: Floats, others: Sequence[Floats], mappings: Floats, size: tuple[int, int]
) -> Singles:
    """Return the share of each cell of crops that boxes cover (crops, 3, rows, columns) [1].

    The person whose box ends lower in the frame stands nearer to the camera. Boxes (crops, 4) of
    targets are x0, y0, x1, y1 [px], `others` (people, 4) of others, for each crop. The mappings
    (crops, 2, 3) are affine, from pixels of crops of a width, height [px] to those of the frame.
    """
    columns, rows = size[0] // MAP_CELL, size[1] // MAP_CELL
    crop = np.repeat(np.arange(len(boxes)), [1 + len(each) for each in others])
    shown = np.concatenate([np.empty((0, 4)), *chain(*zip(boxes[:, None], others, strict=True))])
    first = np.flatnonzero(np.diff(crop, prepend=-1))
    layer = np.where(shown[:, 3] > boxes[crop, 3], 1, 2)
    layer[first] = 0
    cell = MAP_CELL * _scale(mappings)[:, None]
    # Boxes outside of the crop cover nothing.
    half = np.abs(mappings[:, :, :2]) @ (0.5 * np.array(size)) + cell
    middle = mappings[:, :, :2] @ (0.5 * (np.array(size) - 1.0)) + mappings[:, :, 2]
    near = (shown[:, :2] < (middle + half)[crop]) & (shown[:, 2:] > (middle - half)[crop])
    kept = near.all(axis=1) | (layer == 0)
    crop, shown, layer = crop[kept], shown[kept, :, None, None], layer[kept]
    x = MAP_CELL * np.arange(columns) + 0.5 * (MAP_CELL - 1)
    y = MAP_CELL * np.arange(rows)[:, None] + 0.5 * (MAP_CELL - 1)
    covered = np.ones((len(crop), 1, 1))
    for axis in (0, 1):
        along, across, shift = mappings[crop, axis, :, None, None].swapaxes(0, 1)
        # Of upright crops, columns show the box's width, rows its height: few numbers.
        at = sum((f * n for f, n in ((along, x), (across, y)) if f.any()), start=shift)
        width = cell[crop, :, None]
        covered = (
            covered
            * np.clip((at - shown[:, axis]) / width + 0.5, 0.0, 1.0)
            * np.clip((shown[:, axis + 2] - at) / width + 0.5, 0.0, 1.0)
        )
    maps = np.zeros((len(boxes), MAP_COUNT, rows, columns), dtype=np.float32)
    for number, which, cells in zip(crop, layer, covered, strict=True):
        np.maximum(maps[number, which], cells, out=maps[number, which], casting="same_kind")
    return maps
