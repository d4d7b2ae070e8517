"""Selection of marking samples with no other white structure near them in the image.

Across such a sample there is one bar, with grass on both sides. A crossbar, and the other side of a
far circle, are close to a sample in the image only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Integers
from worldpose.compiled import compiled
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate

_STEP: Final = 0.5
"""Spacing of the polylines' corners [m]: the error of a corner arc is then 3 cm, a quarter of its
width."""


@dataclass(frozen=True, eq=False)
class Whites:
    """White structures of a pitch: concatenated polylines of markings and goals.

    Attributes:
        points_world: (n, 3) corners [m], world.
        label: (n,) structure; markings have the indices of `PitchTemplate.sample_lines`, posts and
            crossbars higher ones.
    """

    points_world: Floats
    label: Integers


def whites_of(pitch: PitchTemplate) -> Whites:
    """Return the polylines of a template's markings and goals."""
    parts = [pitch.marking_points(name, _STEP) for name in pitch.marking_names]
    return Whites(
        np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    )


def clear(
    camera: Camera,
    whites: Whites,
    half_width: float,
    places: Floats,
    room: Floats,
    marking: Integers,
) -> NDArray[np.bool_]:
    """Return a mask of places (n,) with no structure but their own marking within a distance.

    Args:
        camera: a single camera.
        whites: of the template.
        half_width: of paint and posts [m].
        places: (n, 2) of samples [px].
        room: (n,) minimum distance to other structures [px].
        marking: (n,) the samples' own labels.
    """
    depth = camera.cam_from_world.apply(whites.points_world)[:, 2]
    corners = camera.project(whites.points_world)
    with np.errstate(divide="ignore"):
        radius = np.where(depth > 0.0, half_width * camera.focal[0] / depth, 0.0)
    result = np.empty(len(places), dtype=np.bool_)
    _clear(corners, radius, whites.label, places, room, marking, result)
    return result


@compiled
def _clear(
    corners: Floats,
    radius: Floats,
    label: Integers,
    places: Floats,
    room: Floats,
    marking: Integers,
    result: NDArray[np.bool_],
) -> None:
    for i in range(len(places)):
        x, y = places[i, 0], places[i, 1]
        result[i] = True
        for j in range(len(corners) - 1):
            if label[j] == marking[i] or label[j] != label[j + 1]:
                continue
            ax, ay = corners[j, 0] - x, corners[j, 1] - y
            dx, dy = corners[j + 1, 0] - corners[j, 0], corners[j + 1, 1] - corners[j, 1]
            share = -(ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-18)
            share = min(max(share, 0.0), 1.0)
            ax, ay = ax + share * dx, ay + share * dy
            limit = room[i] + max(radius[j], radius[j + 1])
            # Points behind the camera are NaN, which compares false.
            if ax * ax + ay * ay < limit * limit:
                result[i] = False
                break
