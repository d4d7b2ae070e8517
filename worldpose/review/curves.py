"""A clip's figures over its frames, for the person who accepts it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Curve:
    """One figure over the frames of a clip.

    Attributes:
        title: what it is, with its unit.
        values: (frames,); NaN where there is nothing.
    """

    title: str
    values: Floats


def clip_curves(
    bodies: Floats, covariance: Floats, filled: NDArray[np.bool_], placed: Floats
) -> tuple[Curve, ...]:
    """Return how many people there are in each frame, and how well they are known.

    Args:
        bodies: (frames, persons, 17, 3) keypoints of the fitted bodies [m], world; NaN = no body.
        covariance: (frames, persons, 17, 3, 3) theirs [m^2].
        filled: (frames, persons) bodies that are there by motion alone.
        placed: (frames, persons, 17, 3) joints that cameras placed [m], of the same people; NaN
            where none did.
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
    """The median of each frame over what it has; NaN where it has nothing."""
    found = np.full(len(values), np.nan)
    for frame, row in enumerate(values):
        there = row[np.isfinite(row)]
        if len(there):
            found[frame] = np.median(there)
    return found
