"""Whether a camera without 2D shows people as a camera of a match does, and if not, why not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.release import Finding
from worldpose.release.camera_rows import CameraRows
from worldpose.release.check_faults import Fault, camera_faults, point_faults
from worldpose.release.check_plausibility import center_of, centers
from worldpose.release.check_settings import CheckSettings
from worldpose.release.shipped import PointSource, View

Floats = NDArray[np.float64]

TALL: Final = (8.0, 1500.0)
"""Least and greatest height of a person in the picture [px]."""
STAND: Final = (0.5, 150.0)
"""Least and greatest height of a camera above the ground [m]."""
FAR: Final = 500.0
"""Greatest distance of a camera from the centre spot [m]."""
TRAVEL: Final = 2.0
"""Distance of a camera's centre from its median beyond which its pose is nonsense [m]."""
_PEOPLE: Final = 4000
"""Bodies that are looked at."""


def sight_share(source: PointSource, points: Floats, rows: CameraRows) -> float:
    """Return which part of all people a camera shows, upright and of a person's size.

    Args:
        source: says what the points are.
        points: (frames, persons, points, 3) [m], world.
        rows: the camera; one that stands in no stadium, or travels, shows nobody.
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
    """Return whether a camera shows hardly anybody though it should.

    A camera that never moves may look at a part of the pitch where nobody comes: it is only
    expected to stand upright in the stadium and to have the pitch in the middle of its picture.
    Of a camera that moves nothing is known without people in frames in which it has a pose.
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
    """Yield findings on cameras that show hardly anybody, and the fault that explains each.

    One writer makes one mistake: of the faults without which cameras show people, at least ten
    times `least_seen` of them, the one that explains most cameras is named first.
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
