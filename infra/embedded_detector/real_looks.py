"""Looks of real cameras, broader than those of renderings, and things that are no people."""

from __future__ import annotations

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image, Singles
from worldpose.training.augmentation import AugmentationSettings, add_grain, recolour, soften, store


class RealLooks(AugmentationSettings):
    """Frequency and strength of augmentations, with those of real cameras."""

    soft: float = 0.3
    coded: float = 0.5
    coarse: float = 0.5
    """Share seen by a sensor of a third of the pixels or more, and enlarged [1]."""
    moved: float = 0.15
    """Share with motion blur [1]."""
    interlaced: float = 0.1
    """Share whose odd rows are of another moment [1]."""
    sharpened: float = 0.4
    """Share sharpened by the camera [1]."""
    cluttered: float = 0.5
    """Share with drawn things that are no people: poles, flags, boards, marks, leaves [1]."""

    def augment(self, picture: Image, rng: np.random.Generator) -> Image:
        """Return the image (height, width, 3) as another camera, light or kit would show it."""
        levels = recolour(picture, self, rng)
        whole = levels.shape[1::-1]
        coarse = _happens(self.coarse, rng)
        if coarse:
            levels = _shrink(levels, np.exp(rng.uniform(np.log(0.33), np.log(0.9))))
        if _happens(self.moved, rng):
            levels = _move(levels, rng)
        if rng.random() < self.soft:
            levels = soften(levels, rng)
        if _happens(self.interlaced, rng):
            levels[1::2] = np.roll(levels[1::2], int(rng.integers(-2, 3)), axis=1)
        if rng.random() < self.grain:
            levels = add_grain(levels, rng)
        if _happens(self.sharpened, rng):
            smooth = cv2.GaussianBlur(levels, (0, 0), rng.uniform(0.6, 1.6))
            levels = levels + np.float32(rng.uniform(0.5, 2.5)) * (levels - smooth)
        seen = store(levels, self, rng)
        if coarse:
            larger = cv2.resize(seen, whole, interpolation=cv2.INTER_LINEAR)
            seen = np.asarray(larger, dtype=np.uint8)
        return seen

    def add_things(self, picture: Image, boxes: Floats, rng: np.random.Generator) -> Image:
        """Return the image with things that are no people beside boxes (people, 4) [px]."""
        return draw_clutter(picture, boxes, rng) if _happens(self.cluttered, rng) else picture


def _happens(share: float, rng: np.random.Generator) -> bool:
    """Return whether an augmentation applies; one that never does draws nothing."""
    return share > 0.0 and bool(rng.random() < share)


def _shrink(levels: Singles, share: float) -> Singles:
    height, width = levels.shape[:2]
    size = (max(int(share * width), 1), max(int(share * height), 1))
    return np.asarray(cv2.resize(levels, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _move(levels: Singles, rng: np.random.Generator) -> Singles:
    """Return the image blurred along a line of 2 to 7 px."""
    reach = 0.5 * rng.uniform(2.0, 7.0)
    angle = rng.uniform(0.0, np.pi)
    steps = np.linspace(-reach, reach, 15)
    kernel = np.zeros((9, 9), dtype=np.float32)
    rows, columns = (
        np.round(4 + steps * way).astype(int) for way in (np.sin(angle), np.cos(angle))
    )
    np.add.at(kernel, (rows, columns), np.float32(1.0 / len(steps)))
    return np.asarray(cv2.filter2D(levels, -1, kernel), dtype=np.float32)


def draw_clutter(picture: Image, boxes: Floats, rng: np.random.Generator) -> Image:
    """Return the image with things that are no people, beside the boxes of people.

    Args:
        picture: (height, width, 3).
        boxes: (people, 4) x0, y0, x1, y1 [px].
        rng: draws kinds, colours, sizes and positions.
    """
    drawn = picture.copy()
    height, width = picture.shape[:2]
    for _ in range(int(rng.integers(1, 9))):
        size = np.exp(rng.uniform(np.log([6.0, 10.0]), np.log([60.0, 110.0]))).astype(int)
        x, y = (int(rng.integers(0, side)) for side in (width, height))
        low, high = np.array([x, y]), np.array([x, y]) + size
        if np.any(np.all((boxes[:, 2:] > low) & (boxes[:, :2] < high), axis=1)):
            continue
        part = drawn[y : y + size[1], x : x + size[0]]
        _THINGS[int(rng.integers(len(_THINGS)))](part, rng)
    return drawn


def _colour(rng: np.random.Generator) -> tuple[int, int, int]:
    if rng.random() < 0.3:
        return (int(rng.integers(225, 256)),) * 3
    red, green, blue = (int(each) for each in rng.integers(0, 256, 3))
    return red, green, blue


def _draw_pole(part: Image, rng: np.random.Generator) -> None:
    """Draw a pole, with a flag at its end or without."""
    wide = min(int(rng.integers(1, 6)), part.shape[1])
    part[:, :wide] = _colour(rng)
    if rng.random() < 0.5:
        part[: max(part.shape[0] // 4, 1), : max(part.shape[1] // 2, 1)] = _colour(rng)


def _draw_board(part: Image, rng: np.random.Generator) -> None:
    """Draw a board with letters."""
    part[:] = _colour(rng)
    text = "".join(chr(int(each)) for each in rng.integers(48, 91, 6))
    scale = max(part.shape[0] / 30.0, 0.3)
    canvas = np.ascontiguousarray(part)
    thick = int(rng.integers(1, 4))
    cv2.putText(canvas, text, (0, int(0.8 * part.shape[0])), 0, scale, _colour(rng), thick)
    part[:] = canvas


def _draw_leaves(part: Image, rng: np.random.Generator) -> None:
    """Draw spots of several sizes around one colour, as of trees and crowds."""
    height, width = part.shape[:2]
    base, spread = np.array(_colour(rng), dtype=np.float32), rng.uniform(15.0, 70.0)
    levels = np.zeros((height, width, 3), dtype=np.float32)
    for cell in (2, 4, 8, 16):
        shape = (height // cell + 2, width // cell + 2, 3 if rng.random() < 0.3 else 1)
        spots = rng.standard_normal(shape, dtype=np.float32)
        enlarged = cv2.resize(spots, (width, height), interpolation=cv2.INTER_LINEAR)
        levels += enlarged.reshape(height, width, -1)
    part[:] = np.clip(base + 0.5 * spread * levels, 0, 255).astype(np.uint8)


def _draw_spot(part: Image, rng: np.random.Generator) -> None:
    """Draw an ellipse: a mark, a ball, a bag or a bucket."""
    canvas = np.ascontiguousarray(part)
    height, width = part.shape[:2]
    axes = (max(width // 2, 1), max(int(height * rng.uniform(0.15, 0.5)), 1))
    cv2.ellipse(canvas, (width // 2, height // 2), axes, 0.0, 0.0, 360.0, _colour(rng), -1)
    part[:] = canvas


_THINGS = (_draw_pole, _draw_board, _draw_leaves, _draw_leaves, _draw_spot)
