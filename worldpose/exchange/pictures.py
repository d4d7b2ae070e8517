"""People in pictures, as annotators show and change them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.review import Origin

Floats = NDArray[np.float64]
CORNER: Final = 0.5
"""What the corner of a picture is from the centre of its first pixel [px]: CVAT and Label Studio
count from the corner, the conventions of worldpose and its COCO files from the centre."""
SEEN: Final = 0.5
"""Keypoints from this confidence on are written as seen, others as hidden [1]."""


class ContentError(ValueError):
    """What another program wrote is not what its format says; no other error is the file's."""


@dataclass(frozen=True, eq=False)
class AnnotatedPerson:
    """One person in one picture.

    Attributes:
        box: (4,) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel.
        keypoints: (17, 2) COCO-17 [px]; NaN where not there.
        visible: (17,) int8: 2 seen, 1 hidden, 0 not there.
        detection: the person's place among the camera's detections of the frame; None where an
            annotator added the person.
        origin: who says so.
        score: the detector's confidence [1]; None where there is none.
    """

    box: Floats
    keypoints: Floats
    visible: NDArray[np.int8]
    detection: int | None = None
    origin: Origin | None = None
    score: float | None = None


@dataclass(frozen=True, eq=False)
class AnnotatedPicture:
    """One picture and the people in it.

    Attributes:
        name: of its file; `/` between folders.
        size: width, height [px].
        people: in no order that matters.
    """

    name: str
    size: tuple[int, int]
    people: tuple[AnnotatedPerson, ...] = ()


def hull(keypoints: Floats) -> Floats:
    """The box (4,) around a person's keypoints [px], of one that was annotated without.

    Args:
        keypoints: (17, 2) [px], at least one of them there.
    """
    there = keypoints[np.isfinite(keypoints).all(axis=1)]
    return np.concatenate([there.min(axis=0), there.max(axis=0)])
