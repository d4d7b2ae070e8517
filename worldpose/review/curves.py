"""Metrics of a clip per frame, for its review."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats


@dataclass(frozen=True, eq=False)
class Curve:
    """One metric over the frames of a clip.

    Attributes:
        title: name with unit.
        values: (frames,); NaN where undefined.
    """

    title: str
    values: Floats


def clip_curves(
    bodies: Floats, covariance: Floats, filled: NDArray[np.bool_], placed: Floats
) -> tuple[Curve, ...]:
    """Return the number of people and their uncertainty per frame.

    Args:
        bodies: (frames, persons, 17, 3) keypoints of the fitted bodies [m], world; NaN = no body.
        covariance: (frames, persons, 17, 3, 3) of these keypoints [m^2].
        filled: (frames, persons) bodies from the motion model alone.
        placed: (frames, persons, 17, 3) triangulated joints [m] of the same people; NaN where
            missing.
    """
    there = np.isfinite(bodies).all(axis=-1)
    people = there.any(axis=-1)
    variance = np.einsum("...ii", covariance) / 3.0
    square = ((bodies - placed) ** 2).sum(axis=-1) / 3.0
    measured = np.isfinite(square)
    total = np.where(measured, square, 0.0).sum(axis=(1, 2))
    count = measured.sum(axis=(1, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.sqrt(total / count)
        share = (filled & people).sum(axis=1) / people.sum(axis=1)
    return (
        Curve("people", people.sum(axis=1).astype(np.float64)),
        Curve("share filled by motion alone [1]", share),
        Curve("standard deviation of a joint along an axis, median [m]", _medians(variance) ** 0.5),
        Curve("bodies from the joints that cameras placed, rms along an axis [m]", apart),
    )


def _medians(values: Floats) -> Floats:
    """Return the median of finite values per frame; NaN without any."""
    found = np.full(len(values), np.nan)
    for frame, row in enumerate(values):
        there = row[np.isfinite(row)]
        if len(there):
            found[frame] = np.median(there)
    return found
