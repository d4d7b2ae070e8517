"""Assignment of candidate joints to people who occlude one another."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.detection.boxes import overlaps
from worldpose.detection.flip_test import SIDES

RIVALRY: Final = 2.0
"""Cost of a candidate that certainly is another person's joint [nats]."""
CLOSE: Final = 0.03
"""Standard deviation of the distance between two estimates of one joint, as a share of the longer
side of the smaller box [1]."""
TOUCHING: Final = 0.02
"""People whose boxes overlap more are rivals [1, intersection over union]."""
LEAST: Final = 0.01
"""Candidates of less probability are dropped, except the first [1]."""
ROUNDS: Final = 4
"""Passes of assignment; few joints change after the second."""


def shared_out(places: Floats, mass: Floats, boxes: Floats) -> NDArray[np.intp]:
    """Return the index of the chosen candidate for each joint (people, 17).

    A map often shows the joints of a neighbour too. People choose their likeliest candidates in
    turn, the most certain person first. A candidate costs more, the more certainly a neighbour has
    the same joint, of either side, there.

    Args:
        places: (people, 17, count, 2) [px], the likeliest first.
        mass: (people, 17, count) probabilities.
        boxes: (people, 4) [px].

    Note:
        Li et al., CrowdPose, 2019: assigns candidate joints to people in crowds.
    """
    people, joints, _ = mass.shape
    taken = np.zeros((people, joints), dtype=np.intp)
    price = -np.log(np.maximum(mass, 1e-9))
    price[..., 1:][mass[..., 1:] < LEAST] = np.inf
    near = overlaps(boxes, boxes) > TOUCHING
    np.fill_diagonal(near, False)
    longer = np.max(boxes[:, 2:] - boxes[:, :2], axis=1)
    order = np.argsort(-mass[..., 0].mean(axis=1), kind="stable")
    other_side = np.array(SIDES)
    paired = other_side != np.arange(joints)
    for _ in range(ROUNDS):
        before = taken.copy()
        for person in order[near[order].any(axis=1)]:
            who = np.flatnonzero(near[person])
            at = np.take_along_axis(places[who], taken[who][..., None, None], axis=2)
            sure = np.take_along_axis(mass[who], taken[who][..., None], axis=2)
            spread = CLOSE * np.minimum(longer[who], longer[person])[:, None, None]
            rival = _rivalry(places[person], at, sure, spread)
            rival += paired[:, None] * _rivalry(
                places[person], at[:, other_side], sure[:, other_side], spread
            )
            taken[person] = np.argmin(price[person] + RIVALRY * rival, axis=1)
        if np.array_equal(before, taken):
            break
    return taken


def _rivalry(places: Floats, at: Floats, sure: Floats, spread: Floats) -> Floats:
    """Return the overlap (17, count) [1] of candidates with joints `at` (neighbours, 17, 1, 2)."""
    apart = np.square(places - at).sum(axis=-1)
    return np.asarray((sure * np.exp(-0.5 * apart / spread**2)).sum(axis=0))
