"""Slips of a few frames, which are smaller than a detector's noise in a single point.

All points of a body slip alike and their noise does not, so the middle of a body's errors shows a
slip where the errors themselves hide it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.release.check_faults import Fault, frame_faults
from worldpose.release.check_settings import CheckSettings
from worldpose.release.shipped import PointSource, View

Floats = NDArray[np.float64]

_POINTS: Final = 8
"""Points that a body needs: their middle is three times as sure as each."""
_BODIES: Final = 1500
"""Bodies that are looked at."""


def slip(source: PointSource, view: View, settings: CheckSettings) -> tuple[Fault, float] | None:
    """Return the slip of frames that explains a source and a view, and the share of error left.

    Args:
        source: 3D points.
        view: a camera with 2D of the same people.
        settings: what counts as an explanation; here for the errors of whole bodies.
    """
    if view.pixels is None or view.pixels.shape[1] != source.points.shape[1]:
        return None
    shared = [name for name in view.skeleton if name in source.skeleton]
    seen = view.pixels[:, :, [view.skeleton.index(name) for name in shared]]
    points = source.points[:, :, [source.skeleton.index(name) for name in shared]]
    known = np.isfinite(seen).all(-1).sum(-1) >= _POINTS
    frame, person = np.nonzero(known[: len(points)])
    if not len(frame):
        return None
    picked = np.unique(np.linspace(0, len(frame) - 1, _BODIES).round().astype(np.int64))
    frame, person = frame[picked], person[picked]
    shipped = _error(points, view, seen, frame, person, None)
    best, least = None, shipped
    for fault in frame_faults(moving=len(view.rows.rotation) > 1):
        error = _error(points, view, seen, frame, person, fault)
        if error < least - 1e-9:
            best, least = fault, error
    if best is None or shipped - least <= settings.least_gain_px:
        return None
    return (best, least / shipped) if least < settings.explained * shipped else None


def _error(
    points: Floats,
    view: View,
    seen: Floats,
    frame: NDArray[np.int64],
    person: NDArray[np.int64],
    fault: Fault | None,
) -> float:
    """Median length [px] of the median error of a body's points; infinite without bodies."""
    there = frame + (0 if fault is None else fault.later_points)
    row = frame + (0 if fault is None else fault.later_camera)
    moving = len(view.rows.rotation) > 1
    within = (there >= 0) & (there < len(points))
    if moving:
        within &= (row >= 0) & (row < len(view.rows.rotation))
    camera = view.rows.camera()
    camera = camera[row[within]] if moving else camera[0]
    pixels = camera.project(points[there[within], person[within]])
    away = pixels - seen[frame[within], person[within]]
    enough = np.isfinite(away).all(-1).sum(-1) >= _POINTS
    if not enough.any():
        return np.inf
    middle = np.nanmedian(away[enough], axis=1)
    return float(np.median(np.linalg.norm(middle, axis=-1)))
