"""Plots of static cameras: clicks on a still, expected ground error, and health over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from data_contracts.arrays import Flags, Floats, Image, Integers, Singles
from data_contracts.pitch import PitchSpec
from worldpose.geometry.cameras import Camera
from worldpose.reports.drawing import (
    HALO,
    INK,
    LINE,
    TEMPLATE,
    draw_label,
    draw_markings,
    markings,
    picture_panels,
    png,
    show_image,
    style,
    style_ground,
)

ACCEPTED: Final = "#0072b2"

MAP_HEIGHT: Final = 790
"""Height of the map of expected errors in its figure [px]."""


class Click(NamedTuple):
    """A clicked point of the template at a place (2,) [px], and whether the fit includes it."""

    name: str
    place: Floats
    inlier: bool


class ErrorMap(NamedTuple):
    """Expected ground error (rows, columns) at x (columns,), y (rows,) [m]; NaN out of view."""

    x: Floats
    y: Floats
    expected: Floats


def plot_health(
    cameras: Sequence[str],
    frame: Integers,
    badness: Floats,
    missing: Floats,
    marks: Sequence[tuple[str, int | None, str]],
) -> bytes:
    """Return a PNG of the health of cameras over time, a row each.

    `frame` (bins + 1,) are the first match frames of the bins, and the frame after the last.
    `badness` (bins, rows), above 1 somebody should look, and `missing` (bins, rows), the share of
    frames without an image, are NaN where not known. `marks` are camera, match frame of a sudden
    change (None = it lasts), and what is written there.
    """
    height = 1.6 + 0.32 * len(cameras)
    figure = Figure(figsize=(14.0, height), dpi=110, layout="constrained", facecolor="white")
    axes = figure.subplots()
    axes.set_facecolor("#d9d9d9")
    rows = np.arange(len(cameras) + 1) - 0.5
    shown = axes.pcolormesh(frame, rows, badness.T, cmap="YlOrRd", vmin=0.0, vmax=2.0)
    gone = np.where(missing.T > 0.0, 1.0, np.nan)
    axes.pcolormesh(frame, rows, gone, cmap="binary", vmin=0.0, vmax=1.0)
    for camera, moment, said in marks:
        row, at = cameras.index(camera), frame[0] if moment is None else moment
        if moment is not None:
            axes.plot([at, at], [row - 0.5, row + 0.5], color=ACCEPTED, linewidth=2.5)
        side = "right" if at > 0.8 * frame[-1] + 0.2 * frame[0] else "left"
        axes.text(
            at, row, f" {said} ", color=INK, fontsize=9, va="center", ha=side, path_effects=HALO
        )
    axes.set_yticks(range(len(cameras)), cameras)
    axes.invert_yaxis()
    axes.set_xlabel("match frame", color=INK)
    style(axes)
    scale = figure.colorbar(shown, ax=axes, pad=0.01)
    scale.set_label("health: above 1, look at it", color=INK)
    return png(figure)


def plot_calibration(
    camera: Camera,
    title: str,
    pitch: PitchSpec,
    *,
    clicks: Sequence[Click] = (),
    still: Image | None = None,
    error_map: ErrorMap | None = None,
) -> bytes:
    """Return a PNG with the template and all clicks over the still, and the coverage map below.

    The camera is single; inlier clicks are circles, outliers crosses with their names. `still` is
    the camera's image (height, width, 3), RGB, None = plain ground.
    """
    width, height = (int(n) for n in camera.image_size)
    below = 0 if error_map is None else MAP_HEIGHT
    figure, (axes,) = picture_panels(
        [title], (-0.5, -0.5), (width, height), still=still, below=below
    )
    if error_map is not None:
        _draw_error_map(figure, error_map, pitch)
    draw_markings(axes, camera, pitch, LINE if still is None else TEMPLATE)
    refused = "#d55e00"
    for click in clicks:
        sign, color = ("o", ACCEPTED) if click.inlier else ("x", refused)
        axes.plot(
            *click.place,
            sign,
            color=color,
            markersize=11.0,
            markerfacecolor="none",
            markeredgewidth=2.2,
            path_effects=HALO,
            zorder=4,
        )
        if not click.inlier:
            x, y = click.place
            draw_label(axes, click.name, (float(x), float(y)), (9, 7), refused)
    return png(figure)


def _draw_error_map(figure: Figure, error_map: ErrorMap, pitch: PitchSpec) -> None:
    """Draw the map in the lowest `MAP_HEIGHT` pixels of a figure."""
    error_range = (0.005, 1.0)  # range of expected ground errors of the colour scale [m]
    high = MAP_HEIGHT / (figure.dpi * figure.get_size_inches()[1])
    axes = figure.add_axes((0.05, 0.08 * high, 0.75, 0.84 * high))
    axes.set(aspect="equal", anchor="E", facecolor="#ececec")
    shades = axes.pcolormesh(
        error_map.x,
        error_map.y,
        np.ma.masked_invalid(error_map.expected),
        norm=LogNorm(error_range[0], error_range[1]),
        cmap="viridis_r",
        shading="nearest",
        zorder=0,
    )
    for line in markings(pitch):
        axes.plot(line[:, 0], line[:, 1], color="white", linewidth=1.0, zorder=1)
    style_ground(axes, pitch)
    beside = figure.add_axes((0.83, 0.12 * high, 0.015, 0.76 * high))
    bar = figure.colorbar(shades, cax=beside, extend="both")
    bar.set_label("expected ground error [m]", color=INK)
    bar.set_ticks([0.01, 0.03, 0.1, 0.3, 1.0], labels=["0.01", "0.03", "0.1", "0.3", "1"])
    axes.set_title("Grey: outside the image", color=INK, loc="left", fontsize=11)


NEAR_PAINT_PX: Final = 12.0
"""Maximum distance of samples to paint [px]; beyond, they are occluded, or their paint is faint."""


def detect_paint(still: Image) -> Flags:
    """Return the mask (height, width) of pixels of a still, RGB, that look like paint.

    They are colourless, bright, brighter than both sides, and part of a long region.
    """
    max_width_px = 15  # maximum width of lines [px]
    contrast = 18  # minimum brightness of paint above both sides [levels of 255]
    grey = cv2.GaussianBlur(cv2.cvtColor(still, cv2.COLOR_RGB2GRAY), (3, 3), 0)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (max_width_px, max_width_px))
    bright = np.asarray(cv2.morphologyEx(grey, cv2.MORPH_TOPHAT, disc)) > contrast
    # Paint is colourless; shirts and boards mostly are not.
    spread = still.max(-1).astype(np.int16) - still.min(-1)
    found: Flags = bright & (spread < 70) & (grey > 90)
    # Remove specks.
    _, labels, sizes, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8))
    long = np.maximum(sizes[:, cv2.CC_STAT_WIDTH], sizes[:, cv2.CC_STAT_HEIGHT]) >= 2 * max_width_px
    long[0] = False
    return np.asarray(long[labels])


def distance_to(paint: Flags) -> Singles:
    """Return the distance (height, width) of every pixel to the nearest paint [px]."""
    if not paint.any():
        return np.full(paint.shape, np.inf, dtype=np.float32)
    away = cv2.distanceTransform((~paint).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, dtype=np.float32)


def marking_distances(camera: Camera, pitch: PitchSpec, distance: Singles) -> Floats:
    """Return distances of projected marking samples to paint (n,) [px].

    The camera is single, the distance that of `distance_to`. The result omits samples without paint
    nearby, which are occluded or outside the image.
    """
    height, width = distance.shape
    pixels = np.concatenate([camera.project(line) for line in markings(pitch)])
    with np.errstate(invalid="ignore"):
        inside = ((pixels > -0.5) & (pixels < np.array([width, height]) - 0.5)).all(-1)
    u, v = np.rint(pixels[inside]).astype(int).T
    found: Floats = distance[v, u].astype(np.float64)
    return np.asarray(found[found < NEAR_PAINT_PX])


def plot_paint(camera: Camera, still: Image, pitch: PitchSpec) -> tuple[bytes, float]:
    """Return a PNG of paint and of distances to it, and the share of markings on paint [1].

    The single camera projects the markings over the distances; its still is RGB.
    """
    on_paint_px = 1.5  # maximum distance to paint of a marking sample on paint [px]
    max_distance_px = 300.0  # distance from which the map is white [px]
    paint = detect_paint(still)
    distance = distance_to(paint)
    off = marking_distances(camera, pitch, distance)
    height, width = paint.shape
    figure, (left, right) = picture_panels(
        ["detected paint", "distance to the paint: brighter is farther"],
        (-0.5, -0.5),
        (width, height),
    )
    show_image(left, np.where(paint, 255, 18).astype(np.uint8))
    # The square root makes distances of a few pixels visible.
    grey = np.sqrt(np.minimum(distance, max_distance_px))
    show_image(right, np.rint(255.0 * grey / max(float(grey.max()), 1.0)).astype(np.uint8))
    draw_markings(right, camera, pitch, TEMPLATE, 0.8, zorder=2)
    return png(figure), float((off < on_paint_px).mean()) if len(off) else float("nan")
