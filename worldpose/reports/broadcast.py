"""Plots of a clip's broadcast camera over time, with uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np
from matplotlib.figure import Figure

from data_contracts.arrays import Flags, Floats, Image, Integers
from data_contracts.pitch import PitchSpec
from worldpose.broadcast_calibration.shots import Shot
from worldpose.formats.joints_file import JointTracks
from worldpose.geometry.cameras import Camera
from worldpose.geometry.pan_tilt import camera_angles
from worldpose.reports.drawing import (
    INK,
    PALETTE,
    TEMPLATE,
    draw_markings,
    draw_people,
    picture_panels,
    png,
    style,
)


def plot_camera_course(
    frame: Integers,
    camera: Camera,
    covariance: Floats,
    before: Camera | None = None,
    given: Mapping[str, Floats] | None = None,
) -> bytes:
    """Return a PNG of a clip's focal length, pan, tilt, roll, k1 and k2 over time.

    Bands are two standard deviations to either side; frames without a camera stay empty.

    `camera` is a batch (frames,), `covariance` (frames, 7, 7) that of a step, in the order of
    `data_contracts.broadcast_calibration.FRAME_STEP`. `before` are the same frames, independent and
    without smoothing, drawn below; `given` is what camera data state, by the name of a curve.
    """
    curves = _curves(camera)
    rough = {} if before is None else _curves(before)
    tilt = curves["tilt [deg]"]
    # Indices into the covariance of a frame's step.
    step = {"rx": 0, "ry": 1, "rz": 2, "log_focal": 3, "k1": 4, "k2": 5}
    with np.errstate(invalid="ignore"):
        spread = {name: np.sqrt(covariance[:, k, k]) for name, k in step.items()}
        turned = np.degrees(spread["ry"]) / np.cos(np.radians(tilt))
    focal = camera.focal[:, 0]
    deviations = (
        focal * spread["log_focal"],
        turned,
        np.degrees(spread["rx"]),
        np.degrees(spread["rz"]),
        spread["k1"],
        spread["k2"],
    )
    figure = Figure(figsize=(14.0, 6.4), dpi=110, layout="constrained", facecolor="white")
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for axes, (name, values), deviation in zip(panels, curves.items(), deviations, strict=True):
        if name in rough:
            axes.plot(frame, rough[name], color=PALETTE[1], linewidth=1.0)
        low, high = values - 2.0 * deviation, values + 2.0 * deviation
        axes.fill_between(frame, low, high, color=PALETTE[0], alpha=0.25, linewidth=0)
        axes.plot(frame, values, color=PALETTE[0], linewidth=1.6)
        if given is not None and name in given:
            axes.plot(frame, given[name], color=INK, linewidth=1.0, linestyle="--")
        axes.set_title(name, color=INK, loc="left", fontsize=12)
        axes.margins(x=0.01)
        axes.ticklabel_format(useOffset=False)
        style(axes)
    for axes in panels[3:]:
        axes.set_xlabel("frame", color=INK)
    return png(figure)


def _curves(camera: Camera) -> dict[str, Floats]:
    pan, tilt, roll = camera_angles(camera)
    return {
        "focal length [px]": camera.focal[:, 0],
        "pan [deg]": pan,
        "tilt [deg]": tilt,
        "roll [deg]": roll,
        "k1": camera.distortion[:, 0],
        "k2": camera.distortion[:, 1],
    }


def largest_pose_changes(before: Camera, after: Camera, tracks: JointTracks) -> tuple[int, int]:
    """Return the frame index and person index with the largest distance between two projections.

    Cameras are batches (frames,). Only people well inside the image count; (0, 0) without any.
    """
    frames, persons = tracks.joints.shape[:2]
    one, two = (
        camera.project(tracks.joints.reshape(frames, -1, 3)).reshape(frames, persons, -1, 2)
        for camera in (before, after)
    )
    width, height = (int(n) for n in after.image_size.reshape(-1, 2)[0])
    with np.errstate(invalid="ignore"):
        inside = ((two > 0.1 * height) & (two < np.array([width, height]) - 0.1 * height)).all(-1)
        apart = np.linalg.norm((one - two).mean(axis=2), axis=-1)
    apart = np.where(inside.all(axis=-1) & np.isfinite(apart), apart, -1.0)
    frame, person = np.unravel_index(int(apart.argmax()), apart.shape)
    return (int(frame), int(person)) if apart.max() >= 0.0 else (0, 0)


def plot_before_after(
    before: Camera,
    after: Camera,
    tracks: JointTracks,
    frame: int,
    person: int,
    *,
    still: Image | None,
    seen: Floats,
    pitch: PitchSpec | None = None,
) -> bytes:
    """Return a PNG of one person, their surroundings and the markings in two camera estimates.

    The cameras are single; `frame` and `person` are indices in `tracks`. Crosses are detected
    keypoints `seen` (detections, 17, 2) [px], the same in both; `still` is (height, width, 3),
    RGB, None = plain.
    """
    shown = after.project(tracks.joints[frame, person])
    middle = np.nan_to_num(shown[np.isfinite(shown).all(axis=-1)].mean(axis=0))
    tall = max(float(np.ptp(shown[np.isfinite(shown[:, 1]), 1])), 30.0)
    gone = shown - before.project(tracks.joints[frame, person])
    moved = float(np.nanmean(np.linalg.norm(gone, axis=-1)))
    titles = ("before", f"after: moved by {moved:.1f} px")
    side = tall * np.array([2.6, 1.7])
    figure, panels = picture_panels(titles, middle - 0.5 * side, side, still=still)
    for axes, camera in zip(panels, (before, after), strict=True):
        draw_markings(axes, camera, pitch, TEMPLATE, 1.3)
        draw_people(axes, camera, tracks, frame)
        axes.plot(*seen.reshape(-1, 2).T, "x", color="white", markersize=5.0, zorder=4)
    return png(figure)


def plot_flow(
    still: Image, start: Floats, end: Floats, rejected: Flags, predicted: Floats
) -> bytes:
    """Return a PNG of the optical flow from a frame, RGB, to the next, with inliers and outliers.

    Points (n, 2) [px] start in the frame, and end in the next one; the estimated camera predicts
    their positions there. `rejected` (n,) are outliers.
    """
    height, width = still.shape[:2]
    longest = float(np.linalg.norm(end - start, axis=-1).max(initial=1e-6))
    # The longest arrow is 6 % of the image width: motion from one frame to the next is small.
    stretch = max(1.0, 0.06 * width / longest)
    title = f"optical flow, lengthened {stretch:.0f} times"
    figure, (axes,) = picture_panels([title], (-0.5, -0.5), (width, height), still=still)
    for chosen, color, label in (
        (~rejected, PALETTE[5], f"{int((~rejected).sum())} move with the camera"),
        (rejected, PALETTE[1], f"{int(rejected.sum())} rejected"),
    ):
        away = (end - start)[chosen] * stretch
        axes.quiver(
            *start[chosen].T,
            *away.T,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            color=color,
            width=0.0016,
            headwidth=4.0,
            label=label,
            zorder=3,
        )
    goes = start + (predicted - start) * stretch
    axes.plot(*goes.T, "o", color=TEMPLATE, markersize=2.6, label="estimated camera", zorder=2)
    axes.legend(loc="lower right", framealpha=0.85, fontsize=11)
    return png(figure)


_BAR: Final = 24
"""Height of the title line above them [px]."""


def programme_sheet(shots: Sequence[Shot]) -> bytes:
    """Return a PNG with a row of frames per clip, under its argument for `--take`."""
    rows = [_row(shot) for shot in shots]
    if not rows:
        rows = [_text(np.zeros((_BAR, 5 * 320, 3), np.uint8), "no clip is proposed")]
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    _, coded = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
    return coded.tobytes()


def _row(shot: Shot) -> Image:
    shown = 5  # frames per clip, in order and evenly spaced
    places = np.linspace(0, len(shot.pictures) - 1, shown).round().astype(int)
    pictures = np.hstack([shot.pictures[place] for place in places])
    bar = np.zeros((_BAR, pictures.shape[1], 3), np.uint8)
    said = f"{shot.first}:{shot.first + shot.count}   {shot.seconds:.1f} s, pan {shot.pan:.2f}"
    return np.vstack([_text(bar, said), pictures])


def _text(bar: Image, said: str) -> Image:
    white = (255, 255, 255)
    cv2.putText(bar, said, (6, _BAR - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, white, 1, cv2.LINE_AA)
    return bar
