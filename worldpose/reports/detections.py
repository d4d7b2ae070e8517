"""Plot of one frame's detections, and of the people reconstructed from all cameras (D1, D4)."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.pitch import PitchSpec
from worldpose.geometry import Camera
from worldpose.reports.bodies import crowded_part
from worldpose.reports.drawing import (
    GRASS,
    INK,
    LINE,
    PALETTE,
    TEMPLATE,
    draw_label,
    draw_skeleton,
    markings,
    person_color,
    png,
    style,
)

USED: Final = PALETTE[5]
LEFT_OUT: Final = PALETTE[1]


def detections_picture(
    camera: Camera,
    *,
    boxes: NDArray[np.floating],
    keypoints: NDArray[np.floating],
    used: NDArray[np.integer],
    joints: Floats,
    person_ids: NDArray[np.int64],
    seen: NDArray[np.bool_],
    still: NDArray[np.uint8] | None = None,
    pitch: PitchSpec | None = None,
    part: tuple[Floats, Floats] | None = None,
) -> bytes:
    """Return a PNG of a part of an image: detections on the left, reconstruction on the right.

    Args:
        camera: a single camera.
        boxes: (detections, 4) x0 y0 x1 y1 [px]; NaN where missing.
        keypoints: (detections, 17, 2) [px].
        used: indices of the detections assigned to a person.
        joints: (persons, 17, 3) [m], world, one colour per person.
        person_ids: (persons,).
        seen: (persons,) whether this camera's own detections support any joint of the person.
        still: background image (height, width, 3), RGB; None = plain ground.
        pitch: draw its markings on the right; None without a pitch.
        part: corner and side lengths (2,) [px] of the part; None = the part with most people.
    """
    whole = joints[np.isfinite(joints).all((-1, -2))]
    corner, side = crowded_part(camera, whole) if part is None else part
    shape = side[1] / side[0]
    figure = Figure(figsize=(14.0, 7.0 * shape + 0.5), dpi=110, facecolor="white")
    figure.set_layout_engine("constrained")
    before, after = figure.subplots(1, 2)
    there = np.isfinite(boxes).all(-1)
    found = np.isfinite(joints).any((-1, -2))
    titles = ("before", "after")
    if part is None:
        titles = (f"before: {int(there.sum())} detections", f"after: {int(found.sum())} people")
    for axes, title in zip((before, after), titles, strict=True):
        axes.set(
            xlim=(corner[0], corner[0] + side[0]),
            ylim=(corner[1] + side[1], corner[1]),
            aspect="equal",
            xticks=[],
            yticks=[],
        )
        axes.set_facecolor(GRASS if pitch is not None else "#f6f6f6")
        style(axes)
        if still is not None:
            axes.imshow(still, zorder=0)
        axes.set_title(title, color=INK, loc="left", fontsize=12)
    for number in np.flatnonzero(there):
        color = USED if number in used else LEFT_OUT
        _box(before, boxes[number], color, dashed=False)
        draw_skeleton(before, keypoints[number], color, 1.6, zorder=3)
    line_color = LINE if still is None else TEMPLATE
    for line in markings(pitch) if pitch is not None else ():
        after.plot(*camera.project(line).T, color=line_color, linewidth=1.2, zorder=1)
    for person in np.flatnonzero(found):
        color = person_color(int(person_ids[person]))
        pixels = camera.project(joints[person])
        draw_skeleton(after, pixels, color, 1.6, zorder=3)
        pixels = pixels[np.isfinite(pixels).all(-1)]
        if not len(pixels):
            continue
        (left, top), (right, bottom) = pixels.min(0), pixels.max(0)
        margin = 0.08 * (bottom - top)
        around = np.array([left - margin, top - margin, right + margin, bottom + margin])
        _box(after, around, color, dashed=not seen[person])
        draw_label(after, f"{person_ids[person]}", (left, top - margin), (0, 3), color)
    return png(figure)


def _box(axes: Axes, box: NDArray[np.floating], color: str, *, dashed: bool) -> None:
    x0, y0, x1, y1 = (float(value) for value in box)
    axes.add_patch(
        Rectangle(
            (x0, y0),
            x1 - x0,
            y1 - y0,
            fill=False,
            color=color,
            linewidth=1.3,
            linestyle="--" if dashed else "-",
            zorder=2,
        )
    )
