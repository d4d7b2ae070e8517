"""From the people net's maps to boxes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from worldpose.detection.bundled_nets import STRIDE


def cell_middles(count: int, device: torch.device) -> Tensor:
    """Where the middles of cells in a row lie in the picture (count,) [px]."""
    return torch.arange(count, device=device) * STRIDE + 0.5 * (STRIDE - 1)


def boxes_at_peaks(logits: Tensor, sides: Tensor, least: float, most: int) -> tuple[Tensor, Tensor]:
    """Return boxes (people, 4) [px] and scores (people,) of one picture, best first.

    Args:
        logits: (rows, columns) that a cell is the middle of somebody.
        sides: (4, rows, columns) from there to left, top, right and bottom [px].
        least: the lowest score reported.
        most: the most people reported.
    """
    score = torch.sigmoid(logits)
    best = functional.max_pool2d(score[None, None], 3, stride=1, padding=1)[0, 0]
    row, column = torch.nonzero((score == best) & (score >= least), as_tuple=True)
    order = torch.argsort(score[row, column], descending=True, stable=True)[:most]
    row, column = row[order], column[order]
    x = cell_middles(score.shape[1], score.device)[column]
    y = cell_middles(score.shape[0], score.device)[row]
    left, top, right, bottom = sides[:, row, column]
    return torch.stack([x - left, y - top, x + right, y + bottom], dim=1), score[row, column]
