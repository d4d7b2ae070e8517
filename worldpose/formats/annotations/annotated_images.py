"""Annotated images, the people in them, and their file in COCO keypoints JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, TypedDict, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.review import Origin
from worldpose.errors import InputError, say_failure

Content = TypeVar("Content")

CORNER: Final = 0.5
"""Offset of the image corner from the centre of the first pixel [px]: CVAT and Label Studio
count from the corner, the conventions of worldpose and its COCO files from the centre."""
SEEN: Final = 0.5
"""Minimum confidence of a visible keypoint; others are written as hidden [1]."""


class ContentError(ValueError):
    """Another program's file does not match its format; errors of the file raise only this."""


def decode_file(
    path: Path, limit: int, decode: Callable[[bytes], Content], expected: str, todo: str
) -> Content:
    """Return what `decode` makes of a file of at most `limit` bytes.

    It raises ContentError or pydantic's error for a bad content; messages say what the file should
    be, `expected`, and what `todo` about another one.
    """
    try:
        size = path.stat().st_size
        if size > limit:
            raise ContentError(f"{size} bytes, more than {limit}")
        return decode(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        said = "nothing" if first["type"] == "missing" else first["msg"]
        said = said.replace("Input should be", "something that is not")
        found = f"{place}: {said}" if place else said
    except (OSError, ContentError) as error:
        found = say_failure(error)
    raise InputError(str(path), expected=expected, found=found[:300], todo=todo)


def first_character(content: bytes) -> bytes:
    """Return the first character of a text in UTF-8 or UTF-16, which tells XML from JSON."""
    return content.lstrip(b"\xef\xbb\xbf\xff\xfe\0 \t\r\n")[:1]


@dataclass(frozen=True, eq=False)
class AnnotatedPerson:
    """One person in one image.

    Attributes:
        box: (4,) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel.
        keypoints: (17, 2) COCO-17 [px]; NaN if missing.
        visible: (17,) int8: 2 visible, 1 hidden, 0 missing.
        detection: index among the camera's detections of the frame; None if an annotator's person.
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
    """One image and the people in it; `name` has `/` for folders, `size` is width, height [px]."""

    name: str
    size: tuple[int, int]
    people: tuple[AnnotatedPerson, ...] = ()


def hull(keypoints: Floats) -> Floats:
    """Return the box (4,) [px] around a person's keypoints (17, 2) [px], of which one is known."""
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
    """Parse attributes without unknown names; empty = none. ContentError if a value is invalid."""
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


Scalar = str | int | float | bool | None


class Given(BaseModel):
    """Part of an external file; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class CocoImage(Given):
    """An image of a COCO file."""

    id: int
    file_name: str = Field(min_length=1)
    width: int = Field(ge=1)
    height: int = Field(ge=1)


class _Person(Given):
    image_id: int
    bbox: tuple[float, float, float, float]
    keypoints: Annotated[tuple[float, ...], Field(min_length=51, max_length=51)] | None = None
    attributes: dict[str, Scalar] = {}


class _Category(Given):
    keypoints: tuple[str, ...] | None = None


class _Dataset(Given):
    images: tuple[CocoImage, ...]
    annotations: tuple[_Person, ...]
    categories: tuple[_Category, ...] = ()


def coco_bytes(pictures: Sequence[AnnotatedImage]) -> bytes:
    """Write a COCO keypoints file; `attributes` holds the fields that COCO lacks."""
    images: list[dict[str, Any]] = []
    people: list[dict[str, Any]] = []
    for number, picture in enumerate(pictures):
        width, height = picture.size
        images.append({"id": number, "file_name": picture.name, "width": width, "height": height})
        for person in picture.people:
            people.append({"id": len(people) + 1, "image_id": number, **_annotation(person)})
    category = {"id": 1, "name": "person", "keypoints": list(COCO17)}
    dataset = {"images": images, "annotations": people, "categories": [category]}
    return (json.dumps(dataset, separators=(",", ":"), allow_nan=False) + "\n").encode()


def read_coco(content: bytes) -> list[AnnotatedImage]:
    """Read the images of a COCO keypoints file, in its order; ContentError for another form."""
    dataset = _Dataset.model_validate_json(content)
    for category in dataset.categories:
        if category.keypoints not in (None, (), COCO17):
            raise ContentError("the joints are not COCO's 17 in their order")
    people: dict[int, list[AnnotatedPerson]] = {image.id: [] for image in dataset.images}
    if len(people) < len(dataset.images):
        raise ContentError("two images have one id")
    for given in dataset.annotations:
        if given.image_id not in people:
            raise ContentError(f"an annotation is of image {given.image_id}, which is not there")
        people[given.image_id].append(_read(given))
    return [
        AnnotatedImage(image.file_name, (image.width, image.height), tuple(people[image.id]))
        for image in dataset.images
    ]


def _annotation(person: AnnotatedPerson) -> dict[str, Any]:
    x, y, right, bottom = person.box.tolist()
    triples = np.column_stack([np.nan_to_num(person.keypoints), person.visible]).tolist()
    return {
        "category_id": 1,
        "iscrowd": 0,
        "bbox": [x, y, right - x, bottom - y],
        "area": (right - x) * (bottom - y),
        "num_keypoints": int((person.visible > 0).sum()),
        "keypoints": [value for a, b, v in triples for value in (a, b, int(v))],
        "attributes": format_attributes(person),
    }


def _read(given: _Person) -> AnnotatedPerson:
    x, y, width, height = given.bbox
    if min(width, height) < 0:
        raise ContentError("a box of negative size")
    triples = np.array(given.keypoints or [0.0] * 51).reshape(17, 3)
    if not np.isin(triples[:, 2], (0, 1, 2)).all():
        raise ContentError("a keypoint's visibility is not 0, 1 or 2")
    there = triples[:, 2] > 0
    attributes = {name: str(value) for name, value in given.attributes.items() if value is not None}
    return AnnotatedPerson(
        box=np.array([x, y, x + width, y + height]),
        keypoints=np.where(there[:, None], triples[:, :2], np.nan),
        visible=triples[:, 2].astype(np.int8),
        **read_attributes(attributes),
    )
