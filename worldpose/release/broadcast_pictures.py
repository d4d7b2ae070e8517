"""How a broadcast camera moves over a clip, and how surely that is known."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from worldpose.cameras import Camera
from worldpose.release.drawing import INK, PALETTE, png, style

Floats = NDArray[np.float64]

_STEP: Final = {"rx": 0, "ry": 1, "rz": 2, "log_focal": 3, "k1": 4, "k2": 5}
"""Places in the covariance of a frame's step."""


def course_picture(frame: NDArray[np.int64], camera: Camera, covariance: Floats) -> bytes:
    """Return a PNG of focal length, pan, tilt, roll, k1 and k2 over a clip.

    Bands are two standard deviations to either side; frames without a camera are left open.

    Args:
        frame: (frames,) match frames.
        camera: a batch (frames,).
        covariance: (frames, 7, 7) of a step, in the order of
            `data_contracts.broadcast_calibration.FRAME_STEP`.
    """
    pan, tilt, roll = angles_of(camera)
    with np.errstate(invalid="ignore"):
        spread = {name: np.sqrt(covariance[:, k, k]) for name, k in _STEP.items()}
        turned = np.degrees(spread["ry"]) / np.cos(np.radians(tilt))
    focal = camera.focal[:, 0]
    curves = (
        ("focal length [px]", focal, focal * spread["log_focal"]),
        ("pan [deg]", pan, turned),
        ("tilt [deg]", tilt, np.degrees(spread["rx"])),
        ("roll [deg]", roll, np.degrees(spread["rz"])),
        ("k1", camera.distortion[:, 0], spread["k1"]),
        ("k2", camera.distortion[:, 1], spread["k2"]),
    )
    figure = Figure(figsize=(14.0, 6.4), dpi=110, layout="constrained", facecolor="white")
    panels = figure.subplots(2, 3, sharex=True).ravel()
    for axes, (name, values, deviation) in zip(panels, curves, strict=True):
        low, high = values - 2.0 * deviation, values + 2.0 * deviation
        axes.fill_between(frame, low, high, color=PALETTE[0], alpha=0.25, linewidth=0)
        axes.plot(frame, values, color=PALETTE[0], linewidth=1.4)
        axes.set_title(name, color=INK, loc="left", fontsize=12)
        axes.margins(x=0.01)
        style(axes)
    for axes in panels[3:]:
        axes.set_xlabel("frame", color=INK)
    return png(figure)


def angles_of(camera: Camera) -> tuple[Floats, Floats, Floats]:
    """Return pan, tilt and roll (frames,) of a camera [deg].

    Pan is from the world's y axis towards x, tilt from the horizon upwards, roll clockwise about
    the view: a camera that rolls so shows a horizon that turns the other way.

    Args:
        camera: a batch (frames,).
    """
    right, down, ahead = np.moveaxis(camera.cam_from_world.rotation, 1, 0)
    pan = np.degrees(np.arctan2(ahead[:, 0], ahead[:, 1]))
    tilt = np.degrees(np.arcsin(np.clip(ahead[:, 2], -1.0, 1.0)))
    roll = np.degrees(np.arctan2(-right[:, 2], -down[:, 2]))
    return pan, tilt, roll
