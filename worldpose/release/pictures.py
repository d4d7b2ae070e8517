"""Pictures of a reconstruction: everybody's way seen from above, and one camera's view."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from data_contracts.pitch import PitchSpec
from worldpose.cameras import Camera
from worldpose.release.drawing import (
    HIPS,
    INK,
    PALE,
    draw_label,
    draw_pitch,
    person_color,
    png,
    style,
)
from worldpose.release.joints_file import JointTracks


def paths_picture(
    tracks: JointTracks,
    *,
    truth: JointTracks | None = None,
    cameras: Mapping[str, Camera] | None = None,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of everybody's way over the ground: the whole place, and people close up.

    Args:
        tracks: a dot a frame and person, with the person's id at the end of its way.
        truth: true ways, as broad grey lines under the dots.
        cameras: single cameras by id, as triangles.
        pitch: its markings are drawn; None where there is no pitch.
    """
    ways = _ground(tracks)
    true_ways = _ground(truth) if truth is not None else np.empty((0, 0, 2))
    everywhere = np.concatenate([ways.reshape(-1, 2), true_ways.reshape(-1, 2)])
    everywhere = everywhere[np.isfinite(everywhere[:, 0])]
    if not len(everywhere):
        everywhere = np.zeros((1, 2))
    close = _frame(everywhere, 2.0)
    centers = {name: camera.center[:2] for name, camera in (cameras or {}).items()}
    corners = [everywhere, *(center[None] for center in centers.values())]
    if pitch is not None:
        corners.append(0.5 * np.array([[-pitch.length, -pitch.width], [pitch.length, pitch.width]]))
    whole = _frame(np.concatenate(corners), 6.0)

    figure = Figure(figsize=(14.0, 5.7), dpi=110, layout="constrained", facecolor="white")
    overview, detail = figure.subplots(1, 2)
    for axes, (low, high) in ((overview, whole), (detail, close)):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_xlabel("x, along the touch line [m]", color=INK)
        axes.set_ylabel("y, across [m]", color=INK)
        style(axes)
        if pitch is not None:
            draw_pitch(axes, pitch)
    for way in true_ways.swapaxes(0, 1):
        overview.plot(*way.T, color="#c9c9c9", linewidth=2.0, zorder=3)
        detail.plot(*way.T, color="#cfcfcf", linewidth=6.0, solid_capstyle="round", zorder=3)
    for person_id, way in zip(tracks.person_ids, ways.swapaxes(0, 1), strict=True):
        color = person_color(int(person_id))
        overview.plot(*way.T, color=color, linewidth=1.2, zorder=4)
        detail.plot(*way.T, ".", color=color, markersize=4.0, zorder=4)
        last = way[np.isfinite(way[:, 0])][-1:]
        detail.plot(*last.T, "o", color=color, markersize=9.0, markeredgecolor="white", zorder=5)
        for x, y in last:
            draw_label(detail, f"{person_id}", (x, y), (7, 7), color)
    for name, center in centers.items():
        overview.plot(*center, "^", color=INK, markersize=8.0, zorder=5)
        draw_label(overview, name, (center[0], center[1]), (6, 6), INK)
    (x0, y0), (x1, y1) = close
    overview.add_patch(
        Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color=PALE, linewidth=1.0, linestyle=":")
    )
    overview.set_title("The whole place, cameras as triangles", color=INK, loc="left", fontsize=12)
    shown = "dots: found, grey: true" if truth is not None else "a dot a frame"
    detail.set_title(
        f"People close up ({shown}, id at the end)", color=INK, loc="left", fontsize=12
    )
    return png(figure)


def _ground(tracks: JointTracks) -> NDArray[np.float64]:
    """Mid-hips on the ground (frames, persons, 2) [m]."""
    middle: NDArray[np.float64] = tracks.joints[..., HIPS, :2].mean(axis=-2)
    return middle


def _frame(
    points: NDArray[np.float64], margin: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of a box around points, widened to 4:3 so that both halves fill their place."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    half = 0.5 * (high - low)
    half = np.maximum(half, [half[1] * 4.0 / 3.0, half[0] * 3.0 / 4.0])
    middle = 0.5 * (low + high)
    return middle - half, middle + half
