"""Shared drawing functions: colours, the pitch, skeletons, labels."""

from __future__ import annotations

import io
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from data_contracts.conventions import COCO17_BONES
from data_contracts.pitch import PitchSpec
from worldpose.pitch import PitchTemplate

PALETTE: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6b4c9a")
"""One colour per person, after Okabe and Ito: distinguishable with any colour vision."""

INK: Final = "#2b2b2b"
PALE: Final = "#9a9a9a"
GRASS: Final = "#f1f5ef"
LINE: Final = "#b5c4b1"
TEMPLATE: Final = "#ffd54a"
"""Colour of markings over a still: on grass, nothing else is this yellow."""
HALO: Final = [withStroke(linewidth=2.5, foreground="white")]
HIPS: Final = (11, 12)
"""Indices of the hips in COCO-17; their middle is a person's position from above."""


def draw_pitch(axes: Axes, pitch: PitchSpec) -> None:
    """Draw the pitch and its lines from above."""
    corner = (-0.5 * pitch.length, -0.5 * pitch.width)
    axes.add_patch(Rectangle(corner, pitch.length, pitch.width, color=GRASS, zorder=0))
    for line in markings(pitch):
        axes.plot(line[:, 0], line[:, 1], color=LINE, linewidth=1.2, zorder=1)


def markings(pitch: PitchSpec) -> list[NDArray[np.float64]]:
    """Return the painted lines as polylines (n, 3) [m], world, sampled every half metre."""
    template = PitchTemplate.from_spec(pitch)
    samples = template.sample_lines(0.5)
    lines = []
    for marking, name in enumerate(samples.names):
        line = samples.points_world[samples.marking == marking]
        arc = template.arcs.get(name)
        if arc is not None and np.isclose(arc.end_angle - arc.start_angle, 2.0 * np.pi):
            line = np.concatenate([line, line[:1]])
        lines.append(line)
    return lines


def draw_skeleton(
    axes: Axes, keypoints: NDArray[np.floating], color: str, width: float, zorder: int
) -> None:
    """Draw bones and joints of one person (17, 2) [px], without NaN joints."""
    gap = np.full((len(COCO17_BONES), 1, 2), np.nan)
    bones = np.concatenate([keypoints[np.array(COCO17_BONES)], gap], axis=1).reshape(-1, 2)
    axes.plot(*bones.T, color=color, linewidth=width, solid_capstyle="round", zorder=zorder)
    axes.plot(*keypoints.T, ".", color=color, markersize=2.2 * width, zorder=zorder)


def draw_label(
    axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], color: str
) -> None:
    """Write a label next to a place; a white halo keeps it readable on any background."""
    axes.annotate(
        text,
        at,
        xytext=offset,
        textcoords="offset points",
        color=color,
        fontsize=11,
        fontweight="bold",
        ha="center" if offset[0] == 0 else "left",
        path_effects=HALO,
        zorder=6,
        annotation_clip=True,
    )


def style(axes: Axes) -> None:
    """Set muted colours and small ticks on axes."""
    axes.tick_params(colors=INK, labelsize=9, length=3)
    for spine in axes.spines.values():
        spine.set_color("#d0d0d0")


def person_color(person_id: int) -> str:
    """Return a person's colour, the same in all plots."""
    return PALETTE[person_id % len(PALETTE)]


def png(figure: Figure) -> bytes:
    """Return the figure as PNG without date or version: equal figures have equal bytes."""
    picture = io.BytesIO()
    # Not savefig, which draws twice. Twice the compression would take as long as drawing.
    FigureCanvasAgg(figure).print_png(  # type: ignore[no-untyped-call]
        picture, metadata={"Software": None}, pil_kwargs={"compress_level": 1}
    )
    return picture.getvalue()
