"""Rendering of fitted bodies over a camera's image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.pitch import PitchSpec
from worldpose.geometry import Camera
from worldpose.reports.body_rendering import paint_bodies, zoomed
from worldpose.reports.drawing import INK, draw_label, markings, person_color, png, style

WIDTH: Final = 1540
"""Width of the image [px]."""
SHARE: Final = 0.3
"""Share of the camera's image to show: players of 80 px are then 210 px tall."""
_GROUND: Final = (206, 217, 202)
_PALE: Final = 0.35
"""Share of white in the colours of large bodies, to make shading visible [1]."""
_SUBPIXEL: Final = 4
"""Fractional bits of pixel coordinates."""


def bodies_picture(
    camera: Camera,
    title: str,
    surfaces: Floats,
    faces: NDArray[np.int64],
    person_ids: Sequence[int] | NDArray[np.int64],
    *,
    still: Image | None = None,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of all bodies in one camera: the part of the image with most people.

    Args:
        camera: a single camera.
        title: names camera, frame and body model.
        surfaces: (persons, vertices, 3) [m], world; NaN for missing people.
        faces: (triangles, 3), counter-clockwise seen from outside.
        person_ids: (persons,).
        still: background image (height, width, 3), RGB, of the camera; None = plain ground.
        pitch: draw its markings if there is no still; None without a pitch.
    """
    present = np.isfinite(surfaces[:, 0, 0])
    ids = np.asarray(person_ids)[present]
    bodies = surfaces[present]
    corner, side = crowded_part(camera, bodies)
    scale = WIDTH / side[0]
    near = zoomed(camera, corner, scale, (WIDTH, round(side[1] * scale)))
    canvas = _background(near, corner, scale, still, pitch)
    colors = np.array([to_rgb(person_color(int(person))) for person in ids]).reshape(-1, 3)
    paint_bodies(canvas, near, bodies, faces, _PALE + (1.0 - _PALE) * colors)

    height, width = canvas.shape[:2]
    figure = Figure(figsize=(14.0, 14.0 * height / width + 0.4), dpi=110, facecolor="white")
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    axes.imshow(canvas)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    style(axes)
    for person, body in zip(ids, bodies, strict=True):
        ((u, v),) = near.project(body[np.argmax(body[:, 2])][None]).tolist()
        if 0.0 <= u < width and 0.0 <= v < height:
            draw_label(axes, f"{person}", (u, v), (0, 8), person_color(int(person)))
    axes.set_title(title, color=INK, loc="left", fontsize=12)
    return png(figure)


def crowded_part(camera: Camera, bodies: Floats) -> tuple[Floats, Floats]:
    """Return corner and side lengths [px] of the part of an image that shows most people.

    Args:
        camera: a single camera.
        bodies: (persons, points, 3) [m], world.
    """
    size = np.asarray(camera.image_size, dtype=np.float64)
    side = SHARE * size
    middles = camera.project(bodies.mean(axis=1))
    inside: NDArray[np.bool_] = np.all((middles >= 0.0) & (middles < size), axis=-1)
    if not inside.any():
        return np.full(2, -0.5), size
    middles = middles[inside]
    apart = np.abs(middles[:, None] - middles)
    together: NDArray[np.bool_] = np.all(apart < 0.45 * side, axis=-1)
    around = middles[together[np.argmax(together.sum(axis=1))]].mean(axis=0)
    return np.clip(around - 0.5 * side, -0.5, size - 0.5 - side), side


def _background(
    camera: Camera, corner: Floats, scale: float, still: Image | None, pitch: PitchSpec | None
) -> Image:
    width, height = (int(n) for n in camera.image_size)
    if still is not None:
        # Pixel (x, y) of the part shows place (x + 0.5) / scale + corner of the still.
        offset = 0.5 / scale + corner
        part = np.array([[1.0 / scale, 0.0, offset[0]], [0.0, 1.0 / scale, offset[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        edge = cv2.BORDER_REPLICATE
        return np.asarray(
            cv2.warpAffine(still, part, (width, height), flags=flags, borderMode=edge), np.uint8
        )
    canvas: Image = np.full((height, width, 3), _GROUND, dtype=np.uint8)
    for line in markings(pitch) if pitch is not None else ():
        pixels = camera.project(line)
        # Points far outside do not fit into 32 bits, and are not visible.
        near: NDArray[np.bool_] = np.all(np.abs(pixels) < 1e4, axis=-1)
        for start in np.flatnonzero(near[:-1] & near[1:]):
            a, b = np.rint(pixels[start : start + 2] * 2**_SUBPIXEL).astype(int).tolist()
            cv2.line(canvas, a, b, (255, 255, 255), 3, cv2.LINE_AA, _SUBPIXEL)
    return canvas
