"""Reprojection check of 3D points against 2D data, with the fault that explains residuals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.release import Finding
from worldpose.dataset.contents import PointSource, View
from worldpose.dataset.faults import Fault, camera_faults, frame_faults, point_faults
from worldpose.dataset.settings import CheckSettings
from worldpose.formats.camera_file import CameraRows
from worldpose.geometry import Camera

Ints = NDArray[np.int64]

SOUND = Fault("none", "as shipped")
"""No repair."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Residuals between a source's points and a view's 2D."""

    view: str
    source: str
    median_px: float
    p95_px: float
    count: int
    height_px: float
    """Median height of a person's 2D."""
    fault: Fault
    """Best explanation; `SOUND` if none is better."""
    explained_px: float
    """The median after repair of the fault."""


@dataclass(frozen=True, eq=False)
class _Sample:
    """2D points of a view, each with its frame, person and index in the source's skeleton."""

    frame: Ints
    person: Ints
    point: Ints
    pixels: Floats


def agreement(source: PointSource, view: View, settings: CheckSettings) -> Agreement | None:
    """Return the residuals between a source and a view, and the fault that explains them best.

    A fault is named if its repair removes most of the error; a 2D point that the camera cannot see
    has infinite error. Frame offsets are also searched with whole bodies.

    Args:
        source: 3D points.
        view: a camera with 2D.
        settings: thresholds for an explanation.

    Returns:
        None if they have no points in common.
    """
    sample = _sample(source, view, settings.sample)
    if sample is None:
        return None
    errors = _errors(source.points, view.rows, sample, SOUND)
    shipped = _median(errors)
    best, least = SOUND, shipped
    for fault in _candidates(moving=len(view.rows.rotation) > 1):
        if shipped < settings.least_gain_px:
            break
        points = source.points if fault.points is None else fault.points(source)
        if points is None:
            continue
        rows = view.rows if fault.camera is None else fault.camera(view.rows)
        error = _median(_errors(points, rows, sample, fault))
        # A tie goes to the first fault.
        if error < least - 1e-9:
            best, least = fault, error
    # This order also works for infinity.
    height = _height(view)
    explains = shipped - least > settings.least_gain_px and least < settings.explained * shipped
    explains = explains and least <= settings.left * height
    if not explains and np.isfinite(shipped) and shipped > settings.least_gain_px:
        found = slip(source, view, settings)
        if found is not None:
            explains, best = True, found[0]
            least = _median(_errors(source.points, view.rows, sample, best))
    finite = errors[np.isfinite(errors)]
    return Agreement(
        view=view.name,
        source=source.name,
        median_px=shipped,
        p95_px=float(np.quantile(finite, 0.95)) if len(finite) == len(errors) else np.inf,
        count=len(errors),
        height_px=height,
        fault=best if explains else SOUND,
        explained_px=least if explains else shipped,
    )


def agreement_findings(found: Iterable[Agreement], settings: CheckSettings) -> Iterator[Finding]:
    """Yield findings, one per fault of a source, with the cameras that show it."""
    named: dict[tuple[str, str, str], list[Agreement]] = {}
    for one in found:
        if one.fault is not SOUND:
            named.setdefault((one.source, one.fault.name, one.fault.says), []).append(one)
        elif one.median_px > settings.tolerated * one.height_px:
            named.setdefault((one.source, "reprojection", _UNEXPLAINED), []).append(one)
    for (source, name, says), group in named.items():
        yield Finding(
            fault=name,
            kind="damage" if name == "reprojection" else "convention",
            where=(source, *(f"cameras/{one.view}" for one in group)),
            says=says,
            figures={
                "shipped_median_px": _capped([one.median_px for one in group]),
                "explained_median_px": _capped([one.explained_px for one in group]),
            },
        )


_UNEXPLAINED = "3D points are not where the 2D has them, and no known convention explains it"


def _candidates(moving: bool) -> Iterator[Fault]:
    yield from camera_faults()
    yield from frame_faults(moving)
    yield from point_faults()


def _sample(source: PointSource, view: View, size: int) -> _Sample | None:
    """Sample 2D points evenly from those that the source also has."""
    if view.pixels is None or view.pixels.shape[1] != source.points.shape[1]:
        return None
    shared = [name for name in view.skeleton if name in source.skeleton]
    in_view = [view.skeleton.index(name) for name in shared]
    in_source = np.array([source.skeleton.index(name) for name in shared], dtype=np.int64)
    count = min(len(view.pixels), len(source.points))
    pixels = view.pixels[:count][:, :, in_view]
    known = np.all(np.isfinite(pixels), axis=-1)
    known &= np.all(np.isfinite(source.points[:count][:, :, in_source]), axis=-1)
    if len(view.rows.rotation) > 1:
        rows = np.all(np.isfinite(view.rows.rotation), axis=(-1, -2))[:count]
        known[: len(rows)] &= rows[:, None, None]
        known[len(rows) :] = False
    frame, person, joint = np.nonzero(known)
    if not len(frame):
        return None
    picked = np.unique(np.linspace(0, len(frame) - 1, size).round().astype(np.int64))
    frame, person, joint = frame[picked], person[picked], joint[picked]
    return _Sample(frame, person, in_source[joint], pixels[frame, person, joint])


def _errors(points: Floats, rows: CameraRows, sample: _Sample, fault: Fault) -> Floats:
    """Return residuals (n,) [px] between projected points and 2D; infinite for invisible points."""
    frame = sample.frame + fault.later_points
    row = sample.frame + fault.later_camera
    moving = len(rows.rotation) > 1
    within = (frame >= 0) & (frame < len(points))
    if moving:
        within &= (row >= 0) & (row < len(rows.rotation))
    if not within.any():
        return np.full(1, np.inf)
    here = points[frame[within], sample.person[within], sample.point[within]]
    camera: Camera = rows.camera()
    pixels = (
        camera[row[within]].project(here[:, None])[:, 0] if moving else (camera[0].project(here))
    )
    away = np.linalg.norm(pixels - sample.pixels[within], axis=-1)
    errors: Floats = np.where(np.isnan(away), np.inf, away)
    # A person who enters or leaves in between is no evidence.
    return errors[np.isfinite(here).all(-1)] if fault.later_points else errors


def _median(errors: Floats) -> float:
    return float(np.sort(errors)[len(errors) // 2]) if len(errors) else np.inf


def _height(view: View) -> float:
    """Return the median height [px] of the people in a view."""
    if view.pixels is None:
        return np.nan
    y = view.pixels[..., 1]
    here = np.isfinite(y).sum(-1) >= 3
    if not here.any():
        return np.nan
    return float(np.median(np.nanmax(y[here], axis=-1) - np.nanmin(y[here], axis=-1)))


def _capped(values: list[float]) -> float:
    """Return the median, capped for a record: 1e6 stands for invisible points."""
    return float(min(np.sort(values)[len(values) // 2], 1e6))


_POINTS: Final = 8
"""Minimum number of points of a body: their mean has a third of the error of each."""
_BODIES: Final = 1500
"""Maximum number of sampled bodies."""


def slip(source: PointSource, view: View, settings: CheckSettings) -> tuple[Fault, float] | None:
    """Return the frame offset that explains a source and a view, and the remaining error share.

    Args:
        source: 3D points.
        view: a camera with 2D of the same people.
        settings: thresholds for an explanation, here for the errors of whole bodies.
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
    """Return the median length [px] of bodies' median residuals; infinite without bodies."""
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
