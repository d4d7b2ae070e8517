"""Removal of bystanders: people who are never on the pitch or near it (D2, in 3D).

A single camera locates a distant foot to a metre, and given 2D poses may show any person. Several
cameras locate a track to centimetres, and so tell people waiting behind the lines from players.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worldpose.tracking.person import Person


def without_bystanders(
    people: list[Person], pitch_size: tuple[float, float] | None, margin: float
) -> list[Person]:
    """Return the people without those who are always farther outside than `margin`.

    Args:
        people: tracks of a clip.
        pitch_size: length along x and width along y of the pitch around the origin [m]; None keeps
            all.
        margin: largest distance of a player outside of the lines [m].
    """
    if pitch_size is None:
        return people
    half = 0.5 * np.array(pitch_size)
    return [person for person in people if _nearest(person, half) <= margin]


def _nearest(person: Person, half: NDArray[np.float64]) -> float:
    """Return the least distance outside of the lines [m]; 0 on the pitch or without position."""
    places = np.array([sighting.joints[:, :2] for sighting in person.sightings.values()])
    places = places[np.isfinite(places[..., 0]).any(axis=1)]
    outside = np.maximum(np.abs(np.nanmean(places, axis=1)) - half, 0.0)
    return float(np.linalg.norm(outside, axis=1).min()) if len(places) else 0.0
