"""Plots of a reconstruction: paths from above, and the view of one camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Image
from data_contracts.conventions import COCO17_HIPS
from data_contracts.pitch import PitchSpec
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.reports.bodies import crowded_part
from worldpose.reports.drawing import (
    GRASS,
    INK,
    LINE,
    PALE,
    PALETTE,
    TEMPLATE,
    draw_label,
    draw_markings,
    draw_people,
    draw_pitch,
    draw_skeleton,
    person_color,
    picture_panels,
    pitch_corners,
    png,
    style_ground,
)


def plot_paths(
    tracks: JointTracks,
    *,
    truth: JointTracks | None = None,
    cameras: Mapping[str, Camera] | None = None,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of all people's paths over the ground: the whole scene, and a close-up.

    There is a dot per frame and person, with the id at the end of the path; true paths are broad
    grey lines under the dots, and single cameras, by id, are triangles.
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
        corners.append(pitch_corners(pitch))
    whole = _frame(np.concatenate(corners), 6.0)

    figure = Figure(figsize=(14.0, 5.7), dpi=110, layout="constrained", facecolor="white")
    overview, detail = figure.subplots(1, 2)
    for axes, (low, high) in ((overview, whole), (detail, close)):
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        style_ground(axes, pitch)
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
        overview.plot(center[0], center[1], "^", color=INK, markersize=8.0, zorder=5)
        draw_label(overview, name, (center[0], center[1]), (6, 6), INK)
    (x0, y0), (x1, y1) = close
    overview.add_patch(
        Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color=PALE, linewidth=1.0, linestyle=":")
    )
    overview.set_title("Overview; triangles are cameras", color=INK, loc="left", fontsize=12)
    shown = "dots: found, grey: true" if truth is not None else "a dot a frame"
    detail.set_title(
        f"People close up ({shown}, id at the end)", color=INK, loc="left", fontsize=12
    )
    return png(figure)


def _ground(tracks: JointTracks) -> Floats:
    """Return mid-hips on the ground (frames, persons, 2) [m]."""
    middle: Floats = tracks.joints[..., COCO17_HIPS, :2].mean(axis=-2)
    return middle


def _frame(points: Floats, margin: float) -> tuple[Floats, Floats]:
    """Return the corners of a box around points, widened to 4:3 so that both plots fit."""
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    half = 0.5 * (high - low)
    half = np.maximum(half, [half[1] * 4.0 / 3.0, half[0] * 3.0 / 4.0])
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def plot_camera_view(
    camera: Camera,
    title: str,
    tracks: JointTracks,
    frame: int,
    *,
    still: Image | None = None,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of markings and people projected into one single camera.

    `frame` is an index in `tracks`; `still` is the background (height, width, 3), RGB, None = plain
    ground.
    """
    width, height = (int(n) for n in camera.image_size)
    figure, (axes,) = picture_panels([title], (-0.5, -0.5), (width, height), still=still)
    draw_markings(axes, camera, pitch, LINE if still is None else TEMPLATE, 1.3)
    draw_people(axes, camera, tracks, frame)
    return png(figure)


def plot_stadium(
    cameras: Mapping[str, Camera],
    title: str,
    tracks: JointTracks,
    *,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of the stadium from above in the first frame: cameras, fields of view, people.

    Shading shows the ground in each single camera's field of view, on and near the pitch if there
    is one: the more cameras see a place, the darker it is.
    """
    hips = tracks.joints[0][:, COCO17_HIPS, :2].mean(axis=1)
    places = [camera.center[None, :2] for camera in cameras.values()] + [hips]
    if pitch is not None:
        places.append(pitch_corners(pitch))
    everything = np.concatenate(places)
    everything = everything[np.isfinite(everything[:, 0])]
    if not len(everything):
        everything = np.zeros((1, 2))
    low, high = everything.min(axis=0) - 8.0, everything.max(axis=0) + np.array([14.0, 8.0])
    proportion = float((high - low)[1] / (high - low)[0])
    figure = Figure(figsize=(14.0, 14.0 * proportion + 0.8), dpi=110, facecolor="white")
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    style_ground(axes, pitch)
    ground = None
    if pitch is not None:
        draw_pitch(axes, pitch)
        corner = (-0.5 * pitch.length - 5.0, -0.5 * pitch.width - 5.0)
        ground = Rectangle(
            corner, pitch.length + 10.0, pitch.width + 10.0, transform=axes.transData
        )
    for name, camera in cameras.items():
        shade = axes.fill(
            *visible_ground(camera).T, color="#4a7fb5", alpha=0.06, linewidth=0, zorder=1
        )[0]
        if ground is not None:
            shade.set_clip_path(ground)
        center = camera.center[:2]
        width, height = camera.image_size
        sides = camera.unproject(np.array([[-0.5, 0.5 * height], [width - 0.5, 0.5 * height]]))
        for x, y in sides.directions[:, :2]:  # short lines along both sides show the direction
            toward = 18.0 * np.array([x, y]) / np.hypot(x, y)
            axes.plot(*np.stack([center, center + toward]).T, color=PALE, linewidth=1.2)
        axes.plot(center[0], center[1], "^", color=INK, markersize=8.0, zorder=5)
        draw_label(axes, name, (center[0], center[1]), (6, 6), INK)
    for person_id, place in zip(tracks.person_ids, hips, strict=True):
        if np.isfinite(place).all():
            color = person_color(int(person_id))
            axes.plot(*place, "o", color=color, markersize=8.0, markeredgecolor="white", zorder=5)
            draw_label(axes, f"{person_id}", (place[0], place[1]), (5, 5), color)
    axes.set_title(title, color=INK, loc="left", fontsize=12)
    return png(figure)


def visible_ground(camera: Camera) -> Floats:
    """Return corners (n, 2) [m], z = 0, of the ground in a camera's field of view, to 130 m."""
    width, height = (float(n) for n in camera.image_size)
    share = np.linspace(0.0, 1.0, 25)[:-1]
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]) - 0.5
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    border = np.concatenate([a + share[:, None] * (b - a) for a, b in sides])
    directions = camera.unproject(border).directions
    directions = directions[np.isfinite(directions[:, 0])]
    flat = np.linalg.norm(directions[:, :2], axis=-1)
    view_length_m = 130.0  # of a drawn field of view: a little more than a pitch's length
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -camera.center[2] / directions[:, 2] * flat
        # Rays that go up never meet the ground: clip them to the drawn length.
        distance = np.where(
            (directions[:, 2] < 0.0) & (distance < view_length_m), distance, view_length_m
        )
        return np.asarray(camera.center[:2] + directions[:, :2] / flat[:, None] * distance[:, None])


@dataclass(frozen=True, eq=False)
class ImageDetections:
    """Detections of one camera in one frame."""

    boxes: NDArray[np.floating]
    """(detections, 4) x0 y0 x1 y1 [px]; NaN where missing."""
    keypoints: NDArray[np.floating]
    """(detections, 17, 2) [px]."""
    used: NDArray[np.integer]
    """Indices of the detections that belong to tracked people."""


@dataclass(frozen=True, eq=False)
class ReconstructedPeople:
    """People of one frame, as all cameras together found them."""

    joints: Floats
    """(persons, 17, 3) [m], world; NaN where missing."""
    person_ids: NDArray[np.integer]
    """(persons,)."""
    seen: Flags
    """(persons,) whether the drawn camera's own detections support any joint of the person."""


def plot_detections(
    camera: Camera,
    detections: ImageDetections,
    people: ReconstructedPeople,
    *,
    still: Image | None = None,
    pitch: PitchSpec | None = None,
    part: tuple[Floats, Floats] | None = None,
) -> bytes:
    """Return a PNG of a part of a single camera's image: detections, and the reconstruction.

    The part has a corner and side lengths (2,) [px]; None = the part with most people. Without a
    still, RGB, the ground is plain.
    """
    boxes, joints = detections.boxes, people.joints
    whole = joints[np.isfinite(joints).all((-1, -2))]
    corner, side = crowded_part(camera, whole) if part is None else part
    there = np.isfinite(boxes).all(-1)
    found = np.isfinite(joints).any((-1, -2))
    titles = ["detections", "reconstruction"]
    if part is None:
        titles[0] += f": {int(there.sum())}"
        titles[1] += f": {int(found.sum())} people"
    # Colour of the ground without a pitch.
    floor = "#f6f6f6"
    ground = GRASS if pitch is not None else floor
    figure, (before, after) = picture_panels(titles, corner, side, still=still, ground=ground)
    used = PALETTE[5]
    left_out = PALETTE[1]
    for number in np.flatnonzero(there):
        color = used if number in detections.used else left_out
        _box(before, boxes[number], color)
        draw_skeleton(before, detections.keypoints[number], color)
    draw_markings(after, camera, pitch, LINE if still is None else TEMPLATE)
    for person in np.flatnonzero(found):
        color = person_color(int(people.person_ids[person]))
        pixels = camera.project(joints[person])
        draw_skeleton(after, pixels, color)
        pixels = pixels[np.isfinite(pixels).all(-1)]
        if not len(pixels):
            continue
        (left, top), (right, bottom) = pixels.min(0), pixels.max(0)
        margin = 0.08 * (bottom - top)
        around = np.array([left - margin, top - margin, right + margin, bottom + margin])
        _box(after, around, color, "-" if people.seen[person] else "--")
        draw_label(after, f"{people.person_ids[person]}", (left, top - margin), (0, 3), color)
    return png(figure)


def _box(axes: Axes, box: NDArray[np.floating], color: str, style: str = "-") -> None:
    x0, y0, x1, y1 = (float(value) for value in box)
    look: dict[str, Any] = {
        "fill": False,
        "color": color,
        "linewidth": 1.3,
        "linestyle": style,
        "zorder": 2,
    }
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, **look))
