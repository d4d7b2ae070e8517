"""Key frames of the broadcast camera, with simulated clicks."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import KeyFrame, KeyFrames
from worldpose.geometry import Camera
from worldpose.pitch import PitchTemplate
from worldpose.simulation.clicking import Clicks, click
from worldpose.simulation.settings import ClickSettings

REACH: Final = 0.1
"""Search range for a key frame around its even place, as a share of the clip's length [1]."""
LOOKS: Final = 5
"""Frames that a person compares for one key frame [1]."""


def click_key_frames(
    cameras: Camera,
    pitch: PitchTemplate,
    people: NDArray[np.float64],
    settings: ClickSettings,
    count: int,
    rng: np.random.Generator,
) -> KeyFrames:
    """Return clicks in frames spread over a clip, each at a local maximum of clickable markings.

    Args:
        cameras: the true ones, a batch (frames,).
        pitch: the painted pitch.
        people: joints (frames, persons, 17, 3) [m], world, of possible occluders.
        settings: accuracy; lines and arcs are always drawn.
        count: number of key frames.
        rng: of the clicks.
    """
    frames = len(people)
    drawing = settings.model_copy(update={"enough": len(pitch.points) + 1})
    picked: dict[int, Clicks] = {}
    for middle in np.linspace(0.0, frames - 1.0, count):
        around = middle + REACH * frames * np.linspace(-1.0, 1.0, LOOKS)
        looks = {
            int(frame): click(
                cameras[int(frame)],
                pitch,
                people[int(frame)],
                drawing,
                clustered=False,
                mistaken=False,
                rng=rng,
            )
            for frame in np.unique(np.clip(np.rint(around), 0, frames - 1))
        }
        best = max(looks, key=lambda frame: (_content(looks[frame]), -abs(frame - middle)))
        if _content(looks[best]):
            picked[best] = looks[best]
    return KeyFrames(
        key_frames=tuple(
            KeyFrame(frame=frame, markings=picked[frame].markings) for frame in sorted(picked)
        )
    )


def _content(clicks: Clicks) -> int:
    """Return a frame's information: points count twice, because they have two coordinates."""
    return 2 * len(clicks.markings.points) + len(clicks.markings.drawn)
