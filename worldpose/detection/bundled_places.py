"""Candidate positions of joints from the keypoint net's maps."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor
from torch.nn import functional

from worldpose.detection.bundled_nets import CELL

APART: Final = 3
"""Cells to either side of a position in which no other position is chosen."""


def likely_places(maps: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return candidate positions of each joint, finer than cells, the likeliest first.

    Positions are the means over the 5 x 5 cells around the peaks of a map.

    Args:
        maps: (batch, joints, rows, columns) logits.
        count: positions of each joint.

    Returns:
        Positions (batch, joints, count, 2) [px of the crop], and the probability around each
        (batch, joints, count); 0 where a map has fewer peaks.
    """
    columns = maps.shape[-1]
    chance = functional.softmax(maps.flatten(2), dim=-1).view_as(maps)
    peak = chance == _highest_near(chance)
    _, cell = torch.where(peak, chance, 0.0).flatten(2).topk(2 * count, dim=-1)
    around = torch.arange(5, device=maps.device)
    # In maps padded by two cells, the 5 x 5 cells around a cell begin at its own row and column.
    padded = functional.pad(chance, (2, 2, 2, 2)).flatten(2)
    first = cell // columns * (columns + 4) + cell % columns
    at = first[..., None, None] + around[:, None] * (columns + 4) + around
    about = padded.gather(-1, at.flatten(2)).view(at.shape)
    mass = about.sum(dim=(-2, -1))
    total = mass.clamp(min=1e-12)
    x = cell % columns + (about * (around - 2.0)).sum(dim=(-2, -1)) / total
    y = cell // columns + (about * (around[:, None] - 2.0)).sum(dim=(-2, -1)) / total
    places = CELL * torch.stack([x, y], dim=-1) + 0.5 * (CELL - 1)
    mass = torch.where(peak.flatten(2).gather(-1, cell), mass, 0.0)
    mass, order = (each[..., :count] for each in mass.sort(dim=-1, descending=True, stable=True))
    return places.gather(2, order[..., None].expand(*order.shape, 2)), mass


def _highest_near(maps: Tensor) -> Tensor:
    """Return the highest value within `APART` cells of each, along rows and columns."""
    for axis in (2, 3):
        border = (0, 0, APART, APART) if axis == 2 else (APART, APART)
        wide = functional.pad(maps, border)
        size = maps.shape[axis]
        two = torch.maximum(wide.narrow(axis, 0, size + 5), wide.narrow(axis, 1, size + 5))
        four = torch.maximum(two.narrow(axis, 0, size + 3), two.narrow(axis, 2, size + 3))
        maps = torch.maximum(four.narrow(axis, 0, size), four.narrow(axis, 3, size))
    return maps
