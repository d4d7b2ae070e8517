"""The pitch from above with all people, as frames of a video."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image
from data_contracts.pitch import PitchSpec
from worldpose.formats.tables import Positions
from worldpose.reports.drawing import GRASS, INK, LINE, markings, person_color

PIXELS_PER_M: Final = 10.0
MARGIN_M: Final = 5.0
"""Ground around the pitch [m]."""
RADIUS_PX: Final = 8


def minimap_frames(positions: Positions, pitch: PitchSpec) -> Iterator[Image]:
    """Yield the pitch from above, an image (height, width, 3) RGB per frame of `positions`.

    A disc is a triangulated person, a ring one placed by the feet alone; the label is the roster
    id, or else the person's number. Images have even sides.
    """
    half = 0.5 * np.array([pitch.length, pitch.width]) + MARGIN_M
    width, height = (2.0 * np.rint(half * PIXELS_PER_M)).astype(int).tolist()

    def locate(xy: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
        pixels = np.stack([xy[..., 0] + half[0], half[1] - xy[..., 1]], axis=-1) * PIXELS_PER_M
        return np.rint(pixels).astype(np.int32)

    ground = np.full((height, width, 3), _rgb(GRASS), dtype=np.uint8)
    for line in markings(pitch):
        cv2.polylines(ground, [locate(line[:, :2])], False, _rgb(LINE), 2, cv2.LINE_AA)
    legend = "disc: triangulated, ring: by the feet"
    for row, frame in enumerate(positions.frames.tolist()):
        canvas = ground.copy()
        _write(canvas, f"frame {frame}   {legend}", (10, 24), INK)
        for p in np.flatnonzero(np.isfinite(positions.xy[row, :, 0])).tolist():
            person = int(positions.person[p])
            x, y = locate(positions.xy[row, p]).tolist()
            thickness = 2 if positions.on_plane[row, p] else cv2.FILLED
            color = person_color(person)
            cv2.circle(canvas, (x, y), RADIUS_PX, _rgb(color), thickness, cv2.LINE_AA)
            _write(canvas, positions.names[p] or str(person), (x + 10, y - 6), color)
        yield canvas


def _write(canvas: Image, text: str, place: tuple[int, int], color: str) -> None:
    """Write a label."""
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _rgb(color), 1, cv2.LINE_AA)


def _rgb(color: str) -> tuple[int, int, int]:
    """Return `#rrggbb` as numbers."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
