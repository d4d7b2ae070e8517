"""People missing from detections, with the boxes and frames to search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from worldpose.detection import Place
from worldpose.detection.crowd import on_pitch
from worldpose.redetection.expected import Expected
from worldpose.redetection.settings import RedetectionSettings

Places = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MissingPeople:
    """People to search for, one per row, by rising frames.

    Attributes:
        frame: (n,) index of the frame.
        person: (n,) index of the person.
        boxes: (n, 4) predicted boxes [px].
        hidden: number of further people, left out because others occlude them.
    """

    frame: Places
    person: Places
    boxes: Floats
    hidden: int


def select_missing_people(
    expected: Expected,
    seen: Flags,
    size: tuple[int, int],
    settings: RedetectionSettings,
    place: Place | None = None,
    margin: float = 0.0,
) -> MissingPeople:
    """Return the people that should be visible and have no detection.

    Args:
        expected: the bodies in view of one camera.
        seen: (frames, persons) whether the person was detected there.
        size: width, height of the frames [px].
        settings: thresholds of visibility.
        place: camera and pitch; None where there is no pitch.
        margin: largest distance outside of the lines that still counts as on the pitch [m].
    """
    boxes = expected.boxes
    with np.errstate(invalid="ignore"):
        tall = boxes[..., 3] - boxes[..., 1] >= settings.min_height_px
        wanted = ~seen & tall & (expected.unsure <= settings.max_uncertainty_m)
        within = (expected.image >= -0.5) & (expected.image <= np.array(size) - 0.5)
    shown = np.asarray(within.all(axis=-1))
    wanted &= shown.mean(axis=-1) >= settings.min_visible_share
    frame, person = np.nonzero(wanted)
    if place is not None and len(frame):
        cut = np.minimum(boxes[frame, person], np.array([*size, *size]) - 0.5)
        inside = on_pitch(cut, place.camera, size, place.pitch, margin)
        frame, person = frame[inside], person[inside]
    bare = np.ones(len(frame), dtype=np.bool_)
    for each in np.unique(frame):
        rows = np.flatnonzero(frame == each)
        there = shown[each, person[rows]] & ~expected.hidden(int(each))[person[rows]]
        bare[rows] = there.mean(axis=-1) >= settings.min_visible_share
    frame, person = frame[bare], person[bare]
    return MissingPeople(frame, person, boxes[frame, person], int(np.count_nonzero(~bare)))


def find_detected_people(
    index: NDArray[np.integer], fits: NDArray[np.integer], dropped: Flags
) -> Flags:
    """Return which people have detections (frames, persons) that fit or could not be judged.

    Args:
        index: (frames, persons), index of the camera's detection; -1 = not seen.
        fits: (frames, detections), index of the person whose body each fits; -1 = none.
        dropped: (frames, detections), that fit no body.
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
