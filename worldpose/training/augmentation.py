"""Image augmentation: light, colours, fog, lens, sensor and codec."""

from __future__ import annotations

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image, Singles
from data_contracts.records import Record


class AugmentationSettings(Record):
    """Frequency and strength of augmentations."""

    strength: float = 1.0
    """Strength of changes of light and colour [1]; 0 = none."""
    recoloured: float = 0.3
    """Share of images with permuted colour channels [1]: kits and skins of any colour."""
    grey: float = 0.04
    """Share without colour [1]."""
    fog: float = 0.15
    """Share with haze [1]."""
    soft: float = 0.35
    """Share blurred or shrunk and enlarged again [1]."""
    coded: float = 0.2
    """Share compressed by a codec [1]."""
    grain: float = 0.5
    """Share with sensor noise [1]."""

    def augment(self, picture: Image, rng: np.random.Generator) -> Image:
        """Return the image (height, width, 3) as another camera, light or kit would show it."""
        levels = recolour(picture, self, rng)
        if rng.random() < self.soft:
            levels = soften(levels, rng)
        if rng.random() < self.grain:
            levels = add_grain(levels, rng)
        return store(levels, self, rng)

    def add_things(self, picture: Image, boxes: Floats, rng: np.random.Generator) -> Image:
        """Return the image with things that are no people beside boxes (people, 4) [px]: none."""
        return picture


def recolour(picture: Image, settings: AugmentationSettings, rng: np.random.Generator) -> Singles:
    """Return the levels (height, width, 3) under another light, in other kits."""
    mixing, offset = _colours(picture[::8, ::8].mean(), settings, rng)
    return np.asarray(
        cv2.transform(picture.astype(np.float32), np.column_stack([mixing, offset])), np.float32
    )


def add_grain(levels: Singles, rng: np.random.Generator) -> Singles:
    """Return the levels with the noise of a sensor."""
    grain = rng.standard_normal((*levels.shape[:2], 1), dtype=np.float32)
    return levels + np.float32(rng.uniform(1.0, 10.0)) * grain


def store(levels: Singles, settings: AugmentationSettings, rng: np.random.Generator) -> Image:
    """Return the image of levels, perhaps compressed by a codec."""
    seen = np.clip(levels, 0.0, 255.0).astype(np.uint8)
    if rng.random() >= settings.coded:
        return seen
    quality = int(rng.integers(25, 90))
    _, code = cv2.imencode(".jpg", seen, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR), dtype=np.uint8)


def _colours(
    middle: float, settings: AugmentationSettings, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return the colour transform of light, camera and air: matrix (3, 3) and offset (3,)."""
    strength = settings.strength
    mixing = np.eye(3)
    if rng.random() < settings.recoloured:
        mixing = mixing[rng.permutation(3)]
    if rng.random() < settings.grey:
        mixing = np.full((3, 3), 1.0 / 3.0)
    vivid = 1.0 + 0.5 * strength * rng.uniform(-1, 1)
    mixing = (vivid * np.eye(3) + (1.0 - vivid) / 3.0) @ mixing
    mixing *= np.exp(0.4 * strength * rng.uniform(-1, 1))
    mixing *= 1.0 + 0.15 * strength * rng.uniform(-1, 1, (3, 1))
    offset = middle + 40.0 * strength * rng.uniform(-1, 1) - mixing.sum(axis=1) * middle
    if rng.random() < settings.fog:
        haze = rng.uniform(0.1, 0.6)
        mixing, offset = (1.0 - haze) * mixing, (1.0 - haze) * offset
        offset = offset + haze * rng.uniform(120, 220)
    return mixing, offset


def soften(levels: Singles, rng: np.random.Generator) -> Singles:
    """Return the levels blurred, or shrunk and enlarged again."""
    if rng.random() < 0.5:
        return np.asarray(cv2.GaussianBlur(levels, (0, 0), rng.uniform(0.4, 1.6)), np.float32)
    height, width = levels.shape[:2]
    share = rng.uniform(0.4, 0.9)
    small = cv2.resize(
        levels, (int(share * width), int(share * height)), interpolation=cv2.INTER_AREA
    )
    return np.asarray(cv2.resize(small, (width, height)), dtype=np.float32)
