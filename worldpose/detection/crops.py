"""Crops of boxes at a net's input size, and the transform back to frame pixels."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Floats, Image


def crop_frames(boxes: Floats, size: tuple[int, int], padding: float) -> Floats:
    """Return crops with a net's aspect ratio around boxes (boxes, 3): left, top, px per crop px.

    Args:
        boxes: (boxes, 4) x0, y0, x1, y1 [px].
        size: width, height of a crop [px].
        padding: size of the crop over that of the box, at its tighter side [1].
    """
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2.0
    extent = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0) * padding
    scale = (extent / size).max(axis=1)
    corner = middle - (np.array(size) - 1.0) / 2.0 * scale[:, None]
    return np.hstack([corner, scale[:, None]])


def cut_crops(picture: Image, frames: Floats, size: tuple[int, int], fill: int = 0) -> Image:
    """Return the crops (boxes, height, width, 3), smoothed where they are smaller than the frame.

    Args:
        picture: the whole frame.
        frames: (boxes, 3) from `crop_frames`.
        size: width, height of a crop [px].
        fill: grey level beyond the frame's border.
    """
    import cv2  # late: it takes a fifth of a second, and planning a run needs none of it

    crops = np.empty((len(frames), size[1], size[0], 3), dtype=np.uint8)
    for crop, (left, top, scale) in zip(crops, frames, strict=True):
        source, shift = picture, np.zeros(2)
        halvings = max(0, int(np.floor(np.log2(max(scale, 1.0)))))
        if halvings:
            # A sample every few pixels would miss those between: shrink the neighbourhood first.
            step = 2**halvings
            first = np.maximum(0, np.floor([left, top]).astype(int) - step)
            last = np.ceil([left + scale * size[0], top + scale * size[1]]).astype(int) + step
            part = picture[first[1] : max(last[1], first[1]), first[0] : max(last[0], first[0])]
            if not part.size:
                crop[:] = fill
                continue
            target = (-(-part.shape[1] // step), -(-part.shape[0] // step))
            padded = cv2.copyMakeBorder(
                part,
                0,
                target[1] * step - part.shape[0],
                0,
                target[0] * step - part.shape[1],
                cv2.BORDER_REPLICATE,
            )
            source = np.asarray(cv2.resize(padded, target, None, 0, 0, cv2.INTER_AREA), np.uint8)
            shift = first.astype(np.float64)
            left, top = (np.array([left, top]) - shift + 0.5) / step - 0.5
            scale = scale / step
        matrix = np.array([[scale, 0.0, left], [0.0, scale, top]])
        cv2.warpAffine(
            source,
            matrix,
            size,
            crop,
            cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            cv2.BORDER_CONSTANT,
            (fill, fill, fill),
        )
    return crops


def in_picture(points: Floats, frames: Floats) -> Floats:
    """Return points of crops in the frame's pixels.

    Args:
        points: (boxes, points, 2) [px of the crop].
        frames: (boxes, 3) from `crop_frames`.
    """
    return np.asarray(points * frames[:, None, 2:] + frames[:, None, :2])
