"""COCO keypoints JSON for annotated images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from data_contracts.conventions import COCO17
from worldpose.formats.annotations.annotated_images import (
    AnnotatedImage,
    AnnotatedPerson,
    ContentError,
    format_attributes,
    read_attributes,
)

Scalar = str | int | float | bool | None


class _Given(BaseModel):
    """Part of an external file; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class _Image(_Given):
    id: int
    file_name: str = Field(min_length=1)
    width: int = Field(ge=1)
    height: int = Field(ge=1)


class _Person(_Given):
    image_id: int
    bbox: tuple[float, float, float, float]
    keypoints: Annotated[tuple[float, ...], Field(min_length=51, max_length=51)] | None = None
    attributes: dict[str, Scalar] = {}


class _Category(_Given):
    keypoints: tuple[str, ...] | None = None


class _Dataset(_Given):
    images: tuple[_Image, ...]
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
    """Read the images of a COCO keypoints file, in its order.

    Raises:
        ContentError: it has another format, other joints, or contradictions.
    """
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
