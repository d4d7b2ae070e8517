"""Frames, their parts and their crops, sampled where the nets are computed.

On a CPU OpenCV samples; on a GPU frames are copied there once, and torch samples all crops of all
frames of a batch at once.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Sequence
from itertools import chain
from typing import Final

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from data_contracts.arrays import Floats, Image, Integers, Singles
from worldpose.detection.bundled_nets import CROP, MAP_COUNT

Frame = Image | Tensor
"""A frame (height, width, 3) of bytes: an array on a CPU, a tensor on a GPU."""
MAP_CELL: Final = 4
"""Pixels of the crop per cell of the maps of boxes [px]."""
OUTSIDE: Final = 115
"""Grey level outside of a frame [of 255]."""
_COPIES: Final[dict[int, tuple[weakref.ref[Image], Tensor]]] = {}
"""Copies on the GPU by the identity of the frame, for as long as it lives."""
_THREAD: Final = threading.local()


def place_frames(images: Sequence[Image], device: str) -> list[Frame]:
    """Return frames on a device; on a GPU each is copied once."""
    return list(images) if device == "cpu" else [_copy(image, device) for image in images]


def _copy(image: Image, device: str) -> Tensor:
    key = id(image)
    known = _COPIES.get(key)
    if known is None or known[0]() is not image:
        copy = torch.from_numpy(image).pin_memory().to(device, non_blocking=True)
        known = weakref.ref(image, lambda _: _COPIES.pop(key, None)), copy
        _COPIES[key] = known
    return known[1]


def resize(image: Frame, zoom: float) -> Frame:
    """Return a frame enlarged or reduced by a factor."""
    height, width = image.shape[:2]
    size = (max(1, round(zoom * width)), max(1, round(zoom * height)))
    if isinstance(image, Tensor):
        planes = image.permute(2, 0, 1)[None].float()
        way = "bilinear" if zoom >= 1.0 else "area"
        resized = functional.interpolate(planes, size[::-1], mode=way)[0]
        return resized.permute(1, 2, 0).round_().to(torch.uint8)
    method = cv2.INTER_LINEAR if zoom >= 1.0 else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=np.uint8)


def _scratch(shape: tuple[int, ...]) -> Image:
    """Return an array of bytes that the thread's next call of its size overwrites.

    Large arrays that come and go cost more for their pages than for what is written to them.
    """
    if not hasattr(_THREAD, "planes"):
        _THREAD.planes = np.empty(0, dtype=np.uint8)
    size = int(np.prod(shape))
    if len(_THREAD.planes) < size:
        _THREAD.planes = np.empty(size, dtype=np.uint8)
    planes: Image = _THREAD.planes[:size].reshape(shape)
    return planes


def pad(images: Sequence[Frame], shape: tuple[int, int]) -> Tensor:
    """Return the planes of images (n, 3, height, width), grey to the right of and below each.

    On a CPU the thread's next call overwrites them.

    Args:
        images: smaller ones of any size.
        shape: height, width [px].
    """
    whole = (len(images), 3, *shape)
    if isinstance(images[0], Tensor):
        padded = images[0].new_full(whole, OUTSIDE)
        for canvas, image in zip(padded, images, strict=True):
            canvas[:, : image.shape[0], : image.shape[1]] = torch.as_tensor(image).permute(2, 0, 1)
        return padded
    scratch = _scratch(whole)
    for planes, image in zip(scratch, images, strict=True):
        height, width = image.shape[:2]
        planes[:, height:], planes[:, :height, width:] = OUTSIDE, OUTSIDE
        # Far faster than a transposition.
        cv2.split(np.asarray(image), list(planes[:, :height, :width]))
    return torch.from_numpy(scratch)


def sample_crops(images: Sequence[Frame], frame: Integers, mappings: Floats) -> Tensor:
    """Return the planes of the crop of each mapping (crops, 3, height, width), of size `CROP`.

    Args:
        images: frames of one size.
        frame: (crops,) index of the frame.
        mappings: (crops, 2, 3) maps of upright crops, from `frame_from_crop`.
    """
    if isinstance(images[0], Tensor):
        frames = torch.stack([torch.as_tensor(image) for image in images])
        return _sample(frames, torch.from_numpy(frame), torch.from_numpy(mappings))
    crops = np.empty((len(frame), 3, CROP[1], CROP[0]), dtype=np.uint8)
    for planes, at, mapping in zip(crops, frame, mappings, strict=True):
        cv2.split(cut_crop(np.asarray(images[at]), mapping, CROP), list(planes))
    return torch.from_numpy(crops)


def _sample(frames: Tensor, frame: Tensor, mappings: Tensor) -> Tensor:
    """Return crops as `sample_crops` does; where a pixel covers several, the mean of as many."""
    crops = frames.new_empty((len(frame), 3, CROP[1], CROP[0]))
    finer = mappings[:, 0, 0].floor().clamp(min=1.0).int()
    for count in finer.unique().tolist():
        rows = torch.nonzero(finer == count)[:, 0]
        places = []
        for axis, side in enumerate(CROP):
            steps = (torch.arange(side * count, dtype=torch.float64) + 0.5) / count - 0.5
            at = mappings[rows, axis, axis, None] * steps + mappings[rows, axis, 2, None]
            places.append(at.to(frames.device, torch.float32))
        across, down = places[0][:, None, :], places[1][:, :, None]
        of = frame[rows].to(frames.device)[:, None, None]
        seen = torch.zeros(len(rows), CROP[1] * count, CROP[0] * count, 3, device=frames.device)
        for right in (0, 1):
            x = across.floor() + right
            for below in (0, 1):
                y = down.floor() + below
                inside = (x >= 0) & (x < frames.shape[2]) & (y >= 0) & (y < frames.shape[1])
                column, row = (
                    at.clamp(0, most - 1).long()
                    for at, most in zip((x, y), (frames.shape[2], frames.shape[1]), strict=True)
                )
                value = torch.where(inside[..., None], frames[of, row, column].float(), OUTSIDE)
                share = (1.0 - (across - x).abs()) * (1.0 - (down - y).abs())
                seen += share[..., None] * value
        mean = functional.avg_pool2d(seen.permute(0, 3, 1, 2), count)
        crops[rows.to(frames.device)] = mean.round().to(torch.uint8)
    return crops


def crops_around(boxes: Floats) -> Floats:
    """Return the crops (people, 3) that show boxes whole: centre x, y [px], frame px per crop px.

    Args:
        boxes: (people, 4) x0, y0, x1, y1 [px].
    """
    sides = boxes[:, 2:] - boxes[:, :2]
    # Size of a crop over that of its box [1]: keypoints may lie outside of a box.
    scale = 1.25 * np.max(sides / np.array(CROP), axis=1)
    middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    return np.column_stack([middle, np.maximum(scale, 1e-3)])


def frame_from_crop(
    crop: Floats, size: tuple[int, int], turn: float = 0.0, mirrored: bool = False
) -> Floats:
    """Return the affine maps (..., 2, 3) from pixels of crops to pixels of the frame.

    Args:
        crop: (..., 3) crops from `crops_around`.
        size: width, height of the crop [px].
        turn: rotation of the crop within the frame, from x to y [rad].
        mirrored: whether the crop is mirrored left to right.
    """
    cos, sin = np.cos(turn), np.sin(turn)
    linear = crop[..., 2, None, None] * np.array([[cos, -sin], [sin, cos]])
    if mirrored:
        linear[..., 0] *= -1.0
    middle = 0.5 * (np.array(size) - 1.0)
    return np.concatenate([linear, (crop[..., :2] - linear @ middle)[..., None]], axis=-1)


def cut_crop(image: Image, mapping: Floats, size: tuple[int, int], outside: int = OUTSIDE) -> Image:
    """Return a crop (height, width, 3), grey outside of the frame.

    Args:
        image: (height, width, 3).
        mapping: (2, 3) affine map from pixels of the crop to those of the frame.
        size: width, height of the crop [px].
        outside: grey level outside of the frame [of 255].
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

    The person whose box ends lower in the frame stands nearer to the camera.

    Args:
        boxes: (crops, 4) box of the target person x0, y0, x1, y1 [px].
        others: boxes (people, 4) of others, for each crop [px].
        mappings: (crops, 2, 3) affine maps from pixels of the crops to those of the frame.
        size: width, height of the crops [px].
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
