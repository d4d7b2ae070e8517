"""Frames, their parts and their crops, sampled where the nets are computed.

On a CPU OpenCV samples; on a GPU frames are copied there once, and torch samples all crops of all
frames of a batch at once.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor
from torch.nn import functional

from data_contracts.arrays import Floats, Image, Singles
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
View = tuple[Frame, float]
"""A frame or a part of it, and the factor by which it is enlarged or reduced [1]."""
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


def borrow(name: str, shape: Sequence[int], dtype: DTypeLike = np.uint8) -> NDArray[Any]:
    """Return an array of the thread, which the thread's next call with this name overwrites.

    Large arrays that come and go cost more for their pages than for what is written to them.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    known = vars(_THREAD).get(name)
    if known is None or len(known) < size:
        known = vars(_THREAD)[name] = np.empty(size, dtype=np.uint8)
    return np.asarray(known[:size].view(dtype).reshape(shape))


def resized_shape(view: View) -> tuple[int, int]:
    """Return the height, width of a view [px]."""
    image, zoom = view
    return max(1, round(zoom * image.shape[0])), max(1, round(zoom * image.shape[1]))


def resize(view: View, into: Image | None = None) -> Frame:
    """Return the view of a frame; on a CPU it may be written `into` an array."""
    (image, zoom), shape = view, resized_shape(view)
    if shape == tuple(image.shape[:2]):
        return image
    if isinstance(image, Tensor):
        planes = image.permute(2, 0, 1)[None].float()
        way = "bilinear" if zoom >= 1.0 else "area"
        resized = functional.interpolate(planes, shape, mode=way)[0]
        return resized.permute(1, 2, 0).round_().to(torch.uint8)
    method = cv2.INTER_LINEAR if zoom >= 1.0 else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, shape[::-1], into, interpolation=method), dtype=np.uint8)


def pad(views: Sequence[View], shape: Sequence[int]) -> Frame:
    """Return views (n, height, width, 3), grey to the right of and below smaller ones of any size.

    On a CPU the thread's next call overwrites them.
    """
    whole, first = (len(views), *shape, 3), views[0][0]
    batch = first.new_empty(whole) if isinstance(first, Tensor) else borrow("views", whole)
    for canvas, view in zip(batch, views, strict=True):
        height, width = resized_shape(view)
        canvas[height:], canvas[:height, width:] = OUTSIDE, OUTSIDE
        inside = canvas[:height, :width]
        if (seen := resize(view, inside)) is not inside:
            inside[:] = seen
    return batch


def sample_crops(
    images: Sequence[Image], boxes: Sequence[Floats], others: Sequence[Floats], device: str
) -> tuple[Floats, Frame, Singles]:
    """Return a crop around each box of some frames of one size, and maps of the boxes around it.

    Boxes are (people, 4) x0, y0, x1, y1 [px], at least one, for each frame, `others` (people, 4)
    those of the neighbours of each person of all frames. Returned are maps from pixels of the crops
    to those of the frames (crops, 2, 3), and crops (crops, height, width, 3) of bytes. On a CPU the
    thread's next call overwrites these. Last are maps of boxes (crops, 3, rows, columns).
    """
    flat = np.concatenate(boxes)
    mappings = frame_from_crop(crops_around(flat), CROP)
    ends = np.cumsum([0, *map(len, boxes)])
    shared = zip(place_frames(images, device), pairwise(ends.tolist()), strict=True)
    if device != "cpu":
        crops: Frame = torch.cat([_sample(frame, mappings[a:b]) for frame, (a, b) in shared])
    else:
        crops = borrow("crops", (len(flat), CROP[1], CROP[0], 3))
        for image, (a, b) in shared:
            for number in range(a, b):
                crops[number] = cut_crop(np.asarray(image), mappings[number], CROP)
    return mappings, crops, surroundings(flat, others, mappings, CROP)


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
    return crops.permute(0, 2, 3, 1).contiguous()
