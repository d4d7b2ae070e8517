"""CSV file of the positions of people on the pitch, triangulated or placed by their feet."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.formats.files import whole_file

COLUMNS: Final = (
    "frame",
    "time_s",
    "person",
    "name",
    "kind",
    "x_m",
    "y_m",
    "x_std_m",
    "y_std_m",
    "xy_correlation",
    "speed_m_s",
    "height_m",
)
SPEED_WINDOW_S: Final = 0.4
"""Time between the two positions that give a speed [s]."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Where the people of a clip are on the pitch.

    Attributes:
        frames: (frames,) match frames.
        person: (persons,) ids.
        names: (persons,) roster id; empty where not known.
        on_plane: (frames, persons), whether the place is that of the feet alone, else the mid-hip
            of triangulated joints.
        xy: (frames, persons, 2) [m], world; NaN where missing.
        covariance: (frames, persons, 2, 2) [m^2].
        height: (persons,) [m]; NaN where not known.
    """

    frames: NDArray[np.integer]
    person: NDArray[np.integer]
    names: Sequence[str]
    on_plane: NDArray[np.bool_]
    xy: Floats
    covariance: Floats
    height: Floats


def write_positions(path: Path, positions: Positions, fps: float) -> None:
    """Write a line per person and frame, frame by frame; missing people have none.

    Columns: frame, time_s (frame / fps), person, name, kind in this frame (triangulated or plane),
    x_m and y_m (world), x_std_m, y_std_m and xy_correlation of their covariance, speed_m_s over
    `SPEED_WINDOW_S` (empty at a track's ends), height_m of people placed by their feet.
    """
    speed = _speeds(positions.xy, fps)
    variance = np.diagonal(positions.covariance, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        std = np.sqrt(variance)
        correlation = positions.covariance[..., 0, 1] / std.prod(axis=-1)
    with whole_file(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for row, frame in enumerate(positions.frames.tolist()):
            for p in np.flatnonzero(np.isfinite(positions.xy[row, :, 0])).tolist():
                numbers = (*positions.xy[row, p], *std[row, p])
                table.writerow(
                    [
                        frame,
                        f"{frame / fps:.4f}",
                        int(positions.person[p]),
                        positions.names[p],
                        "plane" if positions.on_plane[row, p] else "triangulated",
                        *(f"{number:.3f}" for number in numbers),
                        f"{correlation[row, p]:.3f}",
                        f"{speed[row, p]:.2f}" if np.isfinite(speed[row, p]) else "",
                        f"{positions.height[p]:.2f}" if np.isfinite(positions.height[p]) else "",
                    ]
                )


def _speeds(xy: Floats, fps: float) -> Floats:
    """Return speeds (frames, persons) [m/s]; NaN near the ends of a track."""
    half = max(1, round(0.5 * SPEED_WINDOW_S * fps))
    speed = np.full(xy.shape[:2], np.nan)
    if len(xy) > 2 * half:
        steps = np.linalg.norm(xy[2 * half :] - xy[: -2 * half], axis=-1)
        speed[half:-half] = steps * fps / (2 * half)
    return speed
