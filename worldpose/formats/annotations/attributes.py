"""Attributes of an annotated person besides its shape, as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypedDict, get_args

from data_contracts.review import Origin
from worldpose.formats.annotations.pictures import AnnotatedPerson, ContentError


class Attributes(TypedDict):
    """Fields of `AnnotatedPerson` besides its shape."""

    detection: int | None
    origin: Origin | None
    score: float | None


def attributes_of(person: AnnotatedPerson) -> dict[str, str]:
    """Return the attributes of a person, as text by name."""
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
