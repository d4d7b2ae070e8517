"""Contact sheet of a programme's proposed clips, for their confirmation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from worldpose.broadcast_calibration.shots import Shot

_SHOWN: Final = 5
"""Frames per clip, in order and evenly spaced."""
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


def _row(shot: Shot) -> NDArray[np.uint8]:
    places = np.linspace(0, len(shot.pictures) - 1, _SHOWN).round().astype(int)
    pictures = np.hstack([shot.pictures[place] for place in places])
    bar = np.zeros((_BAR, pictures.shape[1], 3), np.uint8)
    said = f"{shot.first}:{shot.first + shot.count}   {shot.seconds:.1f} s, pan {shot.pan:.2f}"
    return np.vstack([_text(bar, said), pictures])


def _text(bar: NDArray[np.uint8], said: str) -> NDArray[np.uint8]:
    white = (255, 255, 255)
    cv2.putText(bar, said, (6, _BAR - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.5, white, 1, cv2.LINE_AA)
    return bar
