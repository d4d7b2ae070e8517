"""Which predicted person is which true one, frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment


def match_frame(
    predicted: NDArray[np.float64], true: NDArray[np.float64], gate: float
) -> NDArray[np.int64]:
    """Return the predicted person that stands for each true one (true persons,), -1 for none.

    One-to-one, with the least sum of mean joint distances, where leaving a true person unmatched
    costs as much as a match at the gate (Hungarian method). Ids play no part.

    Args:
        predicted: (predicted persons, joints, 3) [m]; NaN where missing.
        true: (true persons, joints, 3) [m]; NaN where missing.
        gate: largest mean distance over the joints that both have [m].
    """
    distance = np.linalg.norm(predicted[None] - true[:, None], axis=-1)
    common = np.isfinite(distance)
    total = np.where(common, distance, 0.0).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        mean = np.where(common.any(-1), total / common.sum(-1), np.inf)
    rows, columns = linear_sum_assignment(np.minimum(mean, gate))
    match = np.full(len(true), -1, dtype=np.int64)
    good = mean[rows, columns] <= gate
    match[rows[good]] = columns[good]
    return match
