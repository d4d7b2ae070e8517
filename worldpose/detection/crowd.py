"""Classification of people on the pitch and spectators outside of it (D2)."""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Flags, Floats
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate

HEAD_HEIGHT: Final = 1.75
"""Height of the head above the ground, for a person whose feet the lower border cuts off [m]."""
CUT: Final = 3.0
"""The lower border cuts off a box that ends this near to it [px]."""


def on_pitch(
    boxes: Floats, camera: Camera, image_size: tuple[int, int], pitch: PitchTemplate, margin: float
) -> Flags:
    """Return whether people stand on the pitch or within a margin around it (people,).

    The middle of a box's lower edge is where the feet touch the ground. The ray to a spectator in
    a stand meets the ground farther away than any margin. If the image border cuts off the feet,
    the head position decides, at a person's height above the ground.

    Args:
        boxes: (people, 4) x0, y0, x1, y1 [px].
        camera: the camera that took the frame.
        image_size: width, height [px].
        pitch: its lines and its surface.
        margin: largest distance outside of the lines that still counts as on the pitch [m].
    """
    cut = boxes[:, 3] > image_size[1] - 1 - CUT
    pixels = np.stack(
        [boxes[:, [0, 2]].mean(axis=1), np.where(cut, boxes[:, 1], boxes[:, 3])], axis=1
    )
    rays = camera.unproject(pixels)
    height = np.where(cut, HEAD_HEIGHT, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(3):  # the crown is flat: the second step changes millimetres
            along = (height - rays.origins[:, 2]) / rays.directions[:, 2]
            points = rays.origins + along[:, None] * rays.directions
            inside = np.isfinite(points).all(axis=1)
            ground = pitch.height(
                np.clip(np.where(inside, points[:, 0], 0.0), -pitch.length / 2, pitch.length / 2),
                np.clip(np.where(inside, points[:, 1], 0.0), -pitch.width / 2, pitch.width / 2),
            )
            height = np.where(cut, HEAD_HEIGHT, 0.0) + ground
        return np.asarray(
            inside
            & (along > 0.0)
            & (np.abs(points[:, 0]) <= pitch.length / 2 + margin)
            & (np.abs(points[:, 1]) <= pitch.width / 2 + margin)
        )
