"""Annotated images, the people in them, and their attributes as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.review import Origin

CORNER: Final = 0.5
"""Offset of the image corner from the centre of the first pixel [px]: CVAT and Label Studio
count from the corner, the conventions of worldpose and its COCO files from the centre."""
SEEN: Final = 0.5
"""Minimum confidence of a visible keypoint; others are written as hidden [1]."""


class ContentError(ValueError):
    """Another program's file does not match its format; errors of the file raise only this."""


@dataclass(frozen=True, eq=False)
class AnnotatedPerson:
    """One person in one image.

    Attributes:
        box: (4,) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel.
        keypoints: (17, 2) COCO-17 [px]; NaN if missing.
        visible: (17,) int8: 2 visible, 1 hidden, 0 missing.
        detection: the person's index among the camera's detections of the frame; None if an
            annotator added the person.
        origin: source of the annotation.
        score: the detector's confidence [1]; None if there is none.
    """

    box: Floats
    keypoints: Floats
    visible: NDArray[np.int8]
    detection: int | None = None
    origin: Origin | None = None
    score: float | None = None


@dataclass(frozen=True, eq=False)
class AnnotatedImage:
    """One image and the people in it.

    Attributes:
        name: file name; `/` between folders.
        size: width, height [px].
        people: in arbitrary order.
    """

    name: str
    size: tuple[int, int]
    people: tuple[AnnotatedPerson, ...] = ()


def hull(keypoints: Floats) -> Floats:
    """Return the box (4,) around a person's keypoints [px], for a person without a box.

    Args:
        keypoints: (17, 2) [px], at least one of them not NaN.
    """
    there = keypoints[np.isfinite(keypoints).all(axis=1)]
    return np.concatenate([there.min(axis=0), there.max(axis=0)])


class Attributes(TypedDict):
    """Fields of `AnnotatedPerson` besides its shape."""

    detection: int | None
    origin: Origin | None
    score: float | None


def format_attributes(person: AnnotatedPerson) -> dict[str, str]:
    """Return a person's attributes, as text by name."""
    given = {"detection": person.detection, "origin": person.origin, "score": person.score}
    return {name: str(value) for name, value in given.items() if value is not None}


def read_attributes(given: Mapping[str, str]) -> Attributes:
    """Parse attributes; unknown names are ignored, an empty text means none.

    Raises:
        ContentError: a value is invalid.
    """
    detection, origin, score = (given.get(name) for name in ("detection", "origin", "score"))
    origins: tuple[Origin, ...] = get_args(Origin)
    if detection and not (detection.isdecimal() and detection.isascii() and len(detection) < 10):
        raise ContentError(f"attribute detection is {detection[:40]!r}")
    if origin and origin not in origins:
        raise ContentError(f"attribute origin is {origin[:40]!r}")
    try:
        value = float(score) if score else None
    except ValueError:
        raise ContentError(f"attribute score is {str(score)[:40]!r}") from None
    if value is not None and not math.isfinite(value):
        raise ContentError(f"attribute score is {value}")
    return Attributes(
        detection=int(detection) if detection else None,
        origin=next((each for each in origins if each == origin), None),
        score=value,
    )
