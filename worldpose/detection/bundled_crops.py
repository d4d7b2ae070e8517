"""Crops of a fixed size around boxes, and the transform back from their pixels."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image, Singles

MARGIN: Final = 1.25
"""Size of a crop over that of its box [1]: keypoints may lie outside of a box."""
MAP_CELL: Final = 4
"""Pixels of the crop per cell of these maps [px]."""
MAP_COUNT: Final = 3
"""The target box, boxes of people in front of the target, and of people behind it."""
SAME_PERSON_IOU: Final = 0.6
"""A box that overlaps the target box more is the same person's [1, intersection over union]."""


def crops_around(boxes: Floats, size: tuple[int, int], margin: float = MARGIN) -> Floats:
    """Return the crops (people, 3) that show boxes whole: centre x, y [px], frame px per crop px.

    Args:
        boxes: (people, 4) x0, y0, x1, y1 [px].
        size: width, height of a crop [px].
        margin: size of the crop over that of the box.
    """
    sides = boxes[:, 2:] - boxes[:, :2]
    scale = margin * np.max(sides / np.array(size), axis=1)
    middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    return np.column_stack([middle, np.maximum(scale, 1e-3)])


def frame_from_crop(
    crop: Floats, size: tuple[int, int], turn: float = 0.0, mirrored: bool = False
) -> Floats:
    """Return the affine map (2, 3) from pixels of a crop to pixels of the frame.

    Args:
        crop: (3,) crop from `crops_around`.
        size: width, height of the crop [px].
        turn: rotation of the crop within the frame, from x to y [rad].
        mirrored: whether the crop is mirrored left to right.
    """
    x, y, scale = crop
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    if mirrored:
        linear[:, 0] *= -1.0
    middle = 0.5 * (np.array(size) - 1.0)
    return np.column_stack([linear, np.array([x, y]) - linear @ middle])


def cut_crop(image: Image, mapping: Floats, size: tuple[int, int], outside: int = 115) -> Image:
    """Return a crop (height, width, 3), grey outside of the frame.

    Args:
        image: (height, width, 3).
        mapping: (2, 3) affine map from pixels of the crop to those of the frame.
        size: width, height of the crop [px].
        outside: grey level outside of the frame [of 255].
    """
    shrink = np.sqrt(abs(np.linalg.det(mapping[:, :2])))
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
    below, beside = cells[::-1] * factor - part.shape[:2]
    whole = np.pad(part, ((0, below), (0, beside), (0, 0)), mode="edge")
    small = np.asarray(cv2.resize(whole, cells.tolist(), interpolation=cv2.INTER_AREA), np.uint8)
    moved = (mapping[:, 2] - low - 0.5 * (factor - 1)) / factor
    return small, np.column_stack([mapping[:, :2] / factor, moved])


def surroundings(box: Floats, others: Floats, mapping: Floats, size: tuple[int, int]) -> Singles:
    """Return the share of each cell of a crop that boxes cover (3, rows, columns) [1].

    The person whose box ends lower in the frame stands nearer to the camera.

    Args:
        box: (4,) box of the target person x0, y0, x1, y1 [px].
        others: (people, 4) boxes of others [px].
        mapping: (2, 3) affine map from pixels of the crop to those of the frame.
        size: width, height of the crop [px].
    """
    columns, rows = size[0] // MAP_CELL, size[1] // MAP_CELL
    middles = np.stack(
        np.meshgrid(*(MAP_CELL * np.arange(n) + 0.5 * (MAP_CELL - 1) for n in (columns, rows)))
    )
    at = np.einsum("ij,jrc->irc", mapping[:, :2], middles) + mapping[:, 2, None, None]
    cell = MAP_CELL * float(np.sqrt(abs(np.linalg.det(mapping[:, :2]))))
    boxes = np.concatenate([box[None], others])[:, :, None, None]
    low, high = (at - boxes[:, :2]) / cell, (boxes[:, 2:] - at) / cell
    covered = np.prod(np.clip(low + 0.5, 0.0, 1.0) * np.clip(high + 0.5, 0.0, 1.0), axis=1)
    before = others[:, 3] > box[3]
    maps = np.zeros((MAP_COUNT, rows, columns), dtype=np.float32)
    maps[0] = covered[0]
    maps[1] = covered[1:][before].max(axis=0, initial=0.0)
    maps[2] = covered[1:][~before].max(axis=0, initial=0.0)
    return maps
