"""Whether 3D and 2D are of the same frames where a turning camera's pose is not shipped.

The challenge gives every frame's K and k, but the pose of the first alone. The camera stands in
one place, so in every other frame its three angles follow from the people in it: what they leave
is error, and the frames are right that leave least.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.release import Finding
from worldpose.release.check_faults import LATEST, frame_faults
from worldpose.release.check_plausibility import center_of
from worldpose.release.check_settings import CheckSettings
from worldpose.release.shipped import PointSource, View

Floats = NDArray[np.float64]

_FRAMES: Final = 150
"""Frames that are looked at."""
_POINTS: Final = 30
"""Points in a frame from which its angles are found: those of two people and more."""


def turning_findings(source: PointSource, view: View, settings: CheckSettings) -> Iterator[Finding]:
    """Yield the slip of frames that explains a source and the 2D of a camera without its poses.

    Args:
        source: 3D points.
        view: a camera with 2D of the same people; others yield nothing.
        settings: what counts as an explanation.
    """
    posed = np.isfinite(view.rows.rotation).all((-1, -2))
    if view.pixels is None or view.pixels.shape[1] != source.points.shape[1]:
        return
    if posed.mean() > 0.5 or not np.isfinite(center_of(view.rows)).all():
        return
    left = {late: _left(source, view, late) for late in range(-LATEST, LATEST + 1)}
    best = min(left, key=lambda late: (left[late], abs(late)))
    if left[0] - left[best] > settings.least_gain_px and left[best] < settings.explained * left[0]:
        (fault,) = (f for f in frame_faults(moving=False) if f.later_points == best)
        yield Finding(
            fault=fault.name,
            kind="convention",
            where=(source.name, f"cameras/{view.name}"),
            says=fault.says,
            figures={
                "shipped_median_px": min(left[0], 1e6),
                "explained_median_px": left[best],
            },
        )


def _left(source: PointSource, view: View, late: int) -> float:
    """Median distance [px] of the 2D from the 3D of later frames, each turned as fits best.

    A frame without enough points is left out; infinite where all are.
    """
    assert view.pixels is not None  # asked for only with 2D
    shared = [name for name in view.skeleton if name in source.skeleton]
    seen = view.pixels[:, :, [view.skeleton.index(name) for name in shared]]
    points = source.points[:, :, [source.skeleton.index(name) for name in shared]]
    camera, center = view.rows.lens(), center_of(view.rows)
    first, last = max(0, -late), min(len(seen), len(points) - late, len(view.rows.rotation))
    errors = []
    for frame in np.unique(np.linspace(first, last - 1, _FRAMES).round().astype(np.int64)):
        here, there = seen[frame].reshape(-1, 2), points[frame + late].reshape(-1, 3)
        plane = camera[int(frame)].normalize(here)
        known = np.isfinite(plane).all(-1) & np.isfinite(there).all(-1)
        if known.sum() < _POINTS:
            continue
        plane = plane[known]
        rays = _unit(np.concatenate([plane, np.ones((len(plane), 1))], axis=1))
        ways = _unit(there[known] - center)
        turned = ways @ _turn(ways, rays).T
        ahead = turned[:, 2:] > 0.0
        away = np.where(ahead, turned[:, :2] / np.where(ahead, turned[:, 2:], 1.0) - plane, np.inf)
        errors.append(np.linalg.norm(away * camera.focal[frame], axis=-1))
    return float(np.median(np.concatenate(errors))) if errors else np.inf


def _turn(ways: Floats, rays: Floats) -> Floats:
    """The rotation (3, 3) that brings unit vectors (n, 3) nearest to others."""
    u, _, vt = np.linalg.svd(rays.T @ ways)
    straight = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    return np.asarray(u @ straight @ vt)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
