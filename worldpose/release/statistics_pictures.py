"""The paper's figure of a data set: how far people go, and how long clips are (X3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from data_contracts.release import DataSetStatistics
from worldpose.release.drawing import INK, PALE, png, style

BINS = 20
"""Bars of a histogram, of one round width."""
_BAR = "#3d6fa3"


def statistics_picture(statistics: DataSetStatistics) -> bytes:
    """Return a PNG with the histograms of trajectory lengths and of clip lengths."""
    ways = [way for clip in statistics.clips.values() for way in clip.trajectories_m]
    lengths = [clip.seconds for clip in statistics.clips.values()]
    figure = Figure(figsize=(14.0, 4.2), dpi=110, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    _histogram(left, ways, "length of a player's trajectory [m]", "trajectories")
    _histogram(right, lengths, "length of a clip [s]", "clips")
    people = statistics.subjects_per_frame
    figure.suptitle(
        f"{len(statistics.clips)} {'clip' if len(statistics.clips) == 1 else 'clips'}, "
        f"{statistics.minutes:.1f} min, {statistics.frames:,} frames, {statistics.poses:,} poses, "
        f"{statistics.distance_km:.1f} km"
        + (f", {people:.1f} people in a frame" if people is not None else ""),
        color=INK,
        fontsize=12,
    )
    return png(figure)


def bin_edges(values: Sequence[float]) -> NDArray[np.float64]:
    """Return edges from 0 to beyond the largest value, 1, 2 or 5 times a power of ten apart."""
    top = max(values, default=0.0)
    if top <= 0.0:
        return np.array([0.0, 1.0])
    power = 10.0 ** np.floor(np.log10(top / BINS))
    width = next(power * step for step in (1.0, 2.0, 5.0, 10.0) if power * step * BINS >= top)
    edges: NDArray[np.float64] = np.arange(np.floor(top / width) + 2.0) * width
    return edges


def _histogram(axes: Axes, values: Sequence[float], title: str, count: str) -> None:
    style(axes)
    axes.hist(values, bins=bin_edges(values).tolist(), color=_BAR, edgecolor="white")
    axes.set_xlabel(title, color=INK)
    axes.set_ylabel(count, color=INK)
    axes.grid(axis="y", color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
