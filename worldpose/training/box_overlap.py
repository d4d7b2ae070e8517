"""Intersection over union of boxes, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor


def shared(said: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Return intersection over union [1] of boxes, and the generalised one, which falls below 0.

    Args:
        said: (..., 4) x0, y0, x1, y1 [px].
        true: (..., 4), broadcast against `said`.
    """
    low, high = (
        torch.maximum(said[..., :2], true[..., :2]),
        torch.minimum(said[..., 2:], true[..., 2:]),
    )
    first, last = (
        torch.minimum(said[..., :2], true[..., :2]),
        torch.maximum(said[..., 2:], true[..., 2:]),
    )
    both = (high - low).clamp(min=0).prod(dim=-1)
    hull = (last - first).clamp(min=0).prod(dim=-1) + 1e-6
    area = (said[..., 2:] - said[..., :2]).clamp(min=0).prod(dim=-1)
    union = area + (true[..., 2:] - true[..., :2]).prod(dim=-1) - both + 1e-6
    return both / union, both / union - (hull - union) / hull
