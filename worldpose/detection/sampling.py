"""Frames, their parts and their crops, sampled where the nets are computed.

On a CPU OpenCV samples; on a GPU frames are copied there once, and torch samples all crops of all
frames of a batch at once.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from data_contracts.arrays import Floats, Image
from worldpose.detection.crops import (
    CROP,
    OUTSIDE,
    crops_around,
    cut_crop,
    frame_from_crop,
    surroundings,
)

Frame = Image | Tensor
"""A frame (height, width, 3) of bytes: an array on a CPU, a tensor on a GPU."""
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
        host = torch.from_numpy(image)
        # From pinned memory the copy runs beside other work.
        host = host.pin_memory() if torch.cuda.is_available() else host
        copy = host.to(device, non_blocking=True)
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


def pad(images: Sequence[Frame], shape: Sequence[int]) -> Tensor:
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
    size = int(np.prod(whole))
    # Large arrays that come and go cost more for their pages than for what is written to them.
    if getattr(_THREAD, "size", 0) < size:
        _THREAD.size, _THREAD.planes = size, np.empty(size, dtype=np.uint8)
    scratch = _THREAD.planes[:size].reshape(whole)
    for planes, image in zip(scratch, images, strict=True):
        height, width = image.shape[:2]
        planes[:, height:], planes[:, :height, width:] = OUTSIDE, OUTSIDE
        # Far faster than a transposition.
        cv2.split(np.asarray(image), list(planes[:, :height, :width]))
    return torch.from_numpy(scratch)


def sample_crops(
    images: Sequence[Image],
    boxes: Sequence[Floats],
    others: Sequence[Floats],
    device: str,
) -> tuple[Floats, Tensor, Tensor]:
    """Return a crop around each box of some frames, and maps of the boxes around it.

    Args:
        images: frames of one size.
        boxes: (people, 4) x0, y0, x1, y1 [px], at least one, for each frame.
        others: (people, 4) boxes of the neighbours of each person of all frames [px].
        device: `cpu` or `cuda`.

    Returns:
        Maps from pixels of the crops to those of the frames (crops, 2, 3), planes (crops, 3,
        height, width) of bytes, and maps (crops, 3, rows, columns).
    """
    flat = np.concatenate(boxes)
    mappings = frame_from_crop(crops_around(flat), CROP)
    ends = np.cumsum([0, *map(len, boxes)])
    frames = place_frames(images, device)
    if device != "cpu":
        each = [_sample(f, mappings[a:b]) for f, (a, b) in zip(frames, pairwise(ends), strict=True)]
        crops = torch.cat(each)
    else:
        crops = torch.empty((len(flat), 3, CROP[1], CROP[0]), dtype=torch.uint8)
        of = np.repeat(np.arange(len(boxes)), np.diff(ends))
        for planes, at, mapping in zip(crops.numpy(), of, mappings, strict=True):
            cv2.split(cut_crop(images[int(at)], mapping, CROP), list(planes))
    return mappings, crops, torch.from_numpy(surroundings(flat, others, mappings, CROP))


def _sample(frame: Frame, mappings: Floats) -> Tensor:
    """Return upright crops of a frame; where a pixel covers several, the mean of as many."""
    image = torch.as_tensor(frame)
    planes = image.permute(2, 0, 1)[None].float() - OUTSIDE
    crops = image.new_empty((len(mappings), 3, CROP[1], CROP[0]))
    finer = np.maximum(mappings[:, 0, 0].astype(int), 1)
    for count in np.unique(finer):
        rows = finer == count
        places = []
        for axis, (side, whole) in enumerate(zip(CROP, planes.shape[:1:-1], strict=True)):
            steps = (np.arange(side * count) + 0.5) / count - 0.5
            at = mappings[rows, axis, axis, None] * steps + mappings[rows, axis, 2, None]
            places.append(torch.from_numpy((2.0 * at + 1.0) / whole - 1.0).to(planes))
        x, y = torch.broadcast_tensors(places[0][:, None, :], places[1][:, :, None])
        grid = torch.stack([x, y], dim=-1).flatten(0, 1)[None]
        seen = functional.grid_sample(planes, grid, align_corners=False)
        mean = functional.avg_pool2d(seen.view(3, *x.shape).transpose(0, 1), int(count))
        crops[torch.from_numpy(rows).to(image.device)] = (mean + OUTSIDE).round().to(torch.uint8)
    return crops
