"""Plausibility of cameras without 2D data, and the fault that explains implausible ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.release import Finding
from worldpose.dataset.contents import PointSource, View
from worldpose.dataset.faults import LATEST, Fault, camera_faults, frame_faults, point_faults
from worldpose.dataset.plausibility import center_of, centers
from worldpose.dataset.settings import CheckSettings
from worldpose.formats.camera_file import CameraRows

TALL: Final = (8.0, 1500.0)
"""Minimum and maximum height of a person in the image [px]."""
STAND: Final = (0.5, 150.0)
"""Minimum and maximum height of a camera above the ground [m]."""
FAR: Final = 500.0
"""Maximum distance of a camera from the centre spot [m]."""
TRAVEL: Final = 2.0
"""Distance of a camera's centre from its median beyond which its pose is invalid [m]."""
_PEOPLE: Final = 4000
"""Maximum number of sampled bodies."""


def sight_share(source: PointSource, points: Floats, rows: CameraRows) -> float:
    """Return the share of people that a camera shows upright and at a person's size.

    Args:
        source: names of the points.
        points: (frames, persons, points, 3) [m], world.
        rows: the camera; with an implausible or varying position its share is zero.
    """
    center = center_of(rows)
    if not STAND[0] < center[2] < STAND[1] or np.linalg.norm(center) > FAR:
        return 0.0
    if np.linalg.norm(centers(rows) - center, axis=-1).max() > TRAVEL:
        return 0.0
    ends = points[:, :, [source.skeleton.index(n) for n in ("nose", "left_ankle", "right_ankle")]]
    known = np.all(np.isfinite(ends), axis=(-1, -2))
    moving = len(rows.rotation) > 1
    if moving:
        posed = np.all(np.isfinite(rows.rotation), axis=(-1, -2))[: len(known)]
        known[: len(posed)] &= posed[:, None]
        known[len(posed) :] = False
    frame, person = np.nonzero(known)
    if not len(frame):
        return 0.0
    picked = np.unique(np.linspace(0, len(frame) - 1, _PEOPLE).round().astype(np.int64))
    camera = rows.camera()
    camera = camera[frame[picked]] if moving else camera[0]
    pixels = camera.project(ends[frame[picked], person[picked]])
    tall = pixels[:, 1:, 1].mean(-1) - pixels[:, 0, 1]
    inside = (pixels >= 0.0) & (pixels <= camera.image_size[..., None, :])
    shown = inside.all((-1, -2)) & (tall > TALL[0]) & (tall < TALL[1])
    return float(shown.mean())


def is_blind(source: PointSource, rows: CameraRows, settings: CheckSettings) -> bool:
    """Return whether a camera shows fewer people than expected.

    A static camera can show an empty part of the pitch: it is only expected to be upright in the
    stadium with the pitch in the centre of its image. For a moving camera nothing is known without
    people in frames with a pose.
    """
    if sight_share(source, source.points, rows) >= settings.least_seen:
        return False
    if len(rows.rotation) > 1:
        posed = np.all(np.isfinite(rows.rotation), axis=(-1, -2))[: len(source.points)]
        there = source.points[: len(posed)][posed]
        return not posed.any() or bool(np.isfinite(there).all(-1).any())
    center, forward, down = center_of(rows), rows.rotation[0, 2], rows.rotation[0, 1]
    if not STAND[0] < center[2] < STAND[1] or not forward[2] < 0.0 or not down[2] < 0.0:
        return True
    middle = center - forward * center[2] / forward[2]
    return bool((np.abs(middle[:2]) > np.array(settings.bounds)).any())


def sight_findings(
    source: PointSource, views: Sequence[View], settings: CheckSettings
) -> Iterator[tuple[Finding, Fault | None]]:
    """Yield findings on cameras that show too few people, and the fault that explains each.

    One writer makes one mistake: among the faults whose repair lets cameras show at least ten times
    `least_seen` of the people, the fault that explains most cameras comes first.
    """
    if not views:
        return
    faults = (*camera_faults(), *point_faults())
    share = np.zeros((len(faults), len(views)))
    for row, fault in enumerate(faults):
        points = source.points if fault.points is None else fault.points(source)
        if points is not None:
            for column, view in enumerate(views):
                rows = view.rows if fault.camera is None else fault.camera(view.rows)
                share[row, column] = sight_share(source, points, rows)
    share[share < 10.0 * settings.least_seen] = 0.0
    left = np.ones(len(views), dtype=np.bool_)
    while left.any():
        worth = (share > 0.0)[:, left].sum(1) + share[:, left].mean(1)
        best = int(worth.argmax())
        explained = left & (share[best] > 0.0)
        if not explained.any():
            break
        left &= ~explained
        yield _finding(views, explained, faults[best], share[best]), faults[best]
    if left.any():
        yield _finding(views, left, None, share.max(0, initial=0.0)), None


def _finding(
    views: Sequence[View], which: NDArray[np.bool_], fault: Fault | None, share: Floats
) -> Finding:
    named = [view.name for view, ours in zip(views, which, strict=True) if ours]
    return Finding(
        fault="sees_nobody" if fault is None else fault.name,
        kind="damage" if fault is None else "convention",
        where=tuple(f"cameras/{name}" for name in named),
        says="the camera shows nobody of the clip"
        if fault is None
        else f"{fault.says}: so the camera shows people",
        figures={"explained_share_seen": float(share[which].min())},
    )


_FRAMES: Final = 150
"""Maximum number of sampled frames."""
_POINTS: Final = 30
"""Minimum number of points of a frame for a rotation estimate: more than one person."""


def turning_findings(source: PointSource, view: View, settings: CheckSettings) -> Iterator[Finding]:
    """Yield the frame offset that explains a source and a camera's 2D, independent of its poses.

    Args:
        source: 3D points.
        view: a camera with 2D of the same people; others yield nothing.
        settings: thresholds for an explanation.
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
    """Return the median residual [px] between 2D and 3D of later frames, after optimal rotations.

    A frame without enough points is skipped; infinite without any frame.
    """
    assert view.pixels is not None  # the caller checks that there is 2D
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
    """Return the rotation (3, 3) that best aligns unit vectors (n, 3) with others."""
    u, _, vt = np.linalg.svd(rays.T @ ways)
    straight = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    return np.asarray(u @ straight @ vt)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
