"""Whom to look for again, where, and in which pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.detection import Place
from worldpose.detection.crowd import on_pitch
from worldpose.redetection.expected import Expected
from worldpose.redetection.settings import RedetectionSettings

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sought:
    """People to look for, a row each; frames rise.

    Attributes:
        frame: (n,) place among the frames.
        person: (n,) place among the persons.
        boxes: (n, 4) where they should be [px].
        hidden: how many more there would be, did nobody stand before them.
    """

    frame: Places
    person: Places
    boxes: Floats
    hidden: int


def whom_to_seek(
    expected: Expected,
    seen: Flags,
    size: tuple[int, int],
    settings: RedetectionSettings,
    place: Place | None = None,
    margin: float = 0.0,
) -> Sought:
    """Return who should be seen well and is not.

    Args:
        expected: the bodies before one camera.
        seen: (frames, persons) who was detected there.
        size: width, height of the pictures [px].
        settings: who counts as seen well.
        place: where the camera stands; None where there is no pitch.
        margin: how far outside of the lines is still on the pitch [m].
    """
    boxes = expected.boxes
    with np.errstate(invalid="ignore"):
        tall = boxes[..., 3] - boxes[..., 1] >= settings.least_height_px
        wanted = ~seen & tall & (expected.unsure <= settings.most_unsure_m)
        within = (expected.image >= -0.5) & (expected.image <= np.array(size) - 0.5)
    shown = np.asarray(within.all(axis=-1))
    wanted &= shown.mean(axis=-1) >= settings.least_in_sight
    frame, person = np.nonzero(wanted)
    if place is not None and len(frame):
        cut = np.minimum(boxes[frame, person], np.array([*size, *size]) - 0.5)
        inside = on_pitch(cut, place.camera, size, place.pitch, margin)
        frame, person = frame[inside], person[inside]
    bare = np.ones(len(frame), dtype=np.bool_)
    for each in np.unique(frame):
        rows = np.flatnonzero(frame == each)
        there = shown[each, person[rows]] & ~expected.hidden(int(each))[person[rows]]
        bare[rows] = there.mean(axis=-1) >= settings.least_in_sight
    frame, person = frame[bare], person[bare]
    return Sought(frame, person, boxes[frame, person], int(np.count_nonzero(~bare)))


def who_is_seen(index: NDArray[np.integer], fits: NDArray[np.integer], dropped: Flags) -> Flags:
    """Return who was detected (frames, persons), by detections that fit or could not be judged.

    Args:
        index: (frames, persons), place among the camera's detections; -1 = not seen.
        fits: (frames, detections), place among the persons of the body that each fits; -1 = none.
        dropped: (frames, detections), that fit nobody.
    """
    detections = fits.shape[1]
    seen = np.zeros(index.shape, dtype=np.bool_)
    frame, detection = np.nonzero(fits >= 0)
    seen[frame, fits[frame, detection]] = True
    frame, person = np.nonzero((index >= 0) & (index < detections))
    at = frame, index[frame, person]
    unjudged = (fits[at] < 0) & ~dropped[at]
    seen[frame[unjudged], person[unjudged]] = True
    return seen
