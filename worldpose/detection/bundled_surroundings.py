"""Maps of a crop's target person, of occluders and of occluded people, as inputs of a net."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats

CELL: Final = 4
"""Pixels of the crop per cell of these maps [px]."""
MAPS: Final = 3
"""The target box, boxes of people in front of the target, and of people behind it."""
SAME: Final = 0.6
"""A box that overlaps the target box more is the same person's [1, intersection over union]."""


def surroundings(
    box: Floats, others: Floats, mapping: Floats, size: tuple[int, int]
) -> NDArray[np.float32]:
    """Return the share of each cell of a crop that boxes cover (3, rows, columns) [1].

    The person whose box ends lower in the frame stands nearer to the camera.

    Args:
        box: (4,) of the target person x0, y0, x1, y1 [px].
        others: (people, 4) of others [px].
        mapping: (2, 3) from pixels of the crop to those of the frame.
        size: width, height of the crop [px].
    """
    columns, rows = size[0] // CELL, size[1] // CELL
    middles = np.stack(
        np.meshgrid(*(CELL * np.arange(n) + 0.5 * (CELL - 1) for n in (columns, rows)))
    )
    at = np.einsum("ij,jrc->irc", mapping[:, :2], middles) + mapping[:, 2, None, None]
    cell = CELL * float(np.sqrt(abs(np.linalg.det(mapping[:, :2]))))
    boxes = np.concatenate([box[None], others])[:, :, None, None]
    low, high = (at - boxes[:, :2]) / cell, (boxes[:, 2:] - at) / cell
    covered = np.prod(np.clip(low + 0.5, 0.0, 1.0) * np.clip(high + 0.5, 0.0, 1.0), axis=1)
    before = others[:, 3] > box[3]
    maps = np.zeros((MAPS, rows, columns), dtype=np.float32)
    maps[0] = covered[0]
    maps[1] = covered[1:][before].max(axis=0, initial=0.0)
    maps[2] = covered[1:][~before].max(axis=0, initial=0.0)
    return maps
