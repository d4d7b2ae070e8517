"""Boxes from the people net's maps."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from worldpose.detection.bundled_nets import STRIDE


def cell_middles(count: int, device: torch.device) -> Tensor:
    """Return the centres of the cells of a row in the frame (count,) [px]."""
    return torch.arange(count, device=device) * STRIDE + 0.5 * (STRIDE - 1)


def boxes_at_peaks(logits: Tensor, sides: Tensor, least: float, most: int) -> tuple[Tensor, Tensor]:
    """Return boxes (people, 4) [px] and scores (people,) of one frame, best first.

    Args:
        logits: (rows, columns) that a cell is a person's centre.
        sides: (4, rows, columns) distances from there to left, top, right and bottom [px].
        least: lowest score reported.
        most: most people reported.
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
