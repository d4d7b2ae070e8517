"""Clicked points and drawn lines of images in the files of CVAT, Label Studio and COCO.

Pixels follow this project: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field, TypeAdapter

from data_contracts.arrays import Floats
from worldpose.formats.annotations.annotated_images import (
    CORNER,
    CocoImage,
    ContentError,
    Given,
    decode_file,
)
from worldpose.formats.annotations.programs import Answer, read_xml

MAX_BYTES: Final = 1 << 26
"""Maximum file size [bytes]."""
_PAIRS: Final = re.compile(r"-?[0-9.]+(?:[eE][+-]?\d+)?,-?[0-9.]+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True, eq=False)
class MarkedImage:
    """Labelled shapes in one image.

    Attributes:
        name: name of the image, as the file has it.
        size: width, height [px].
        points: label and (2,) pixel of every click, in the order of the file.
        lines: label and (points, 2) pixels of every drawn line.
    """

    name: str
    size: tuple[int, int]
    points: tuple[tuple[str, Floats], ...]
    lines: tuple[tuple[str, Floats], ...]


def read_marked_images(path: Path) -> list[MarkedImage]:
    """Return the images of a CVAT for images XML, Label Studio JSON or COCO keypoints JSON file.

    Raises:
        InputError: the file has none of these forms, or no labelled point or line.
    """

    def decode(content: bytes) -> list[MarkedImage]:
        begin = content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1]
        decoders = {b"<": _read_cvat, b"[": _read_label_studio}
        found = decoders.get(begin, _read_coco)(content)
        images = [image for image in found if image.points or image.lines]
        if not images:
            raise ContentError("no labelled point or line")
        return images

    expected = "labelled points as CVAT for images XML 1.1, Label Studio JSON or COCO keypoints"
    todo = "Export the clicks from the annotator in one of these forms."
    return decode_file(path, MAX_BYTES, decode, expected, todo)


def _read_cvat(content: bytes) -> Iterator[MarkedImage]:
    root = read_xml(content)
    if root.tag != "annotations":
        raise ContentError(f"the root is <{root.tag[:40]}>, not <annotations>")
    for image in root.iter("image"):
        name = image.get("name", "")
        points: list[tuple[str, Floats]] = []
        lines: list[tuple[str, Floats]] = []
        for shape in image.iter():
            if shape.tag not in ("points", "polyline") or shape.get("outside") == "1":
                continue
            label, text = shape.get("label", ""), shape.get("points", "")
            given = text.split(";")
            if not all(_PAIRS.fullmatch(pair.strip()) for pair in given):
                raise ContentError(f"{name}: {label}: points are {text[:60]!r}")
            try:
                pixels = np.array([pair.split(",") for pair in given], dtype=np.float64) - CORNER
            except ValueError:
                raise ContentError(f"{name}: {label}: points are {text[:60]!r}") from None
            if shape.tag == "points":
                points += [(label, pixel) for pixel in pixels]
            else:
                lines.append((label, pixels))
        try:
            size = (int(image.get("width", "")), int(image.get("height", "")))
        except ValueError:
            raise ContentError(f"{name}: an image without width and height") from None
        yield MarkedImage(name, size, tuple(points), tuple(lines))


class _Task(Given):
    data: dict[str, Any]
    annotations: tuple[Answer, ...] = ()


class _Place(Given):
    x: float
    y: float
    keypointlabels: tuple[str, ...] = Field(min_length=1, max_length=1)


class _Outline(Given):
    points: tuple[tuple[float, float], ...]
    polygonlabels: tuple[str, ...] = Field(min_length=1, max_length=1)


class _Region(Given):
    type: str
    original_width: int = Field(ge=1)
    original_height: int = Field(ge=1)
    value: dict[str, Any]


def _read_label_studio(content: bytes) -> Iterator[MarkedImage]:
    for number, task in enumerate(TypeAdapter(tuple[_Task, ...]).validate_json(content)):
        answers = [each for each in task.annotations if not each.was_cancelled]
        names = [value for value in task.data.values() if isinstance(value, str)]
        name = names[0] if names else f"task {number}"
        points: list[tuple[str, Floats]] = []
        lines: list[tuple[str, Floats]] = []
        sizes = set()
        for each in answers[-1].result if answers else ():
            if each.get("type") not in ("keypointlabels", "polygonlabels"):
                continue
            region = _Region.model_validate(each)
            size = (region.original_width, region.original_height)
            sizes.add(size)
            pixels = np.array(size) / 100.0
            if region.type == "keypointlabels":
                place = _Place.model_validate(region.value)
                points.append(
                    (place.keypointlabels[0], np.array([place.x, place.y]) * pixels - CORNER)
                )
            else:
                outline = _Outline.model_validate(region.value)
                lines.append((outline.polygonlabels[0], np.array(outline.points) * pixels - CORNER))
        if len(sizes) > 1:
            raise ContentError(f"{name}: regions of images of {len(sizes)} sizes")
        if sizes:
            yield MarkedImage(name, sizes.pop(), tuple(points), tuple(lines))


class _Category(Given):
    id: int
    keypoints: tuple[str, ...] = ()


class _Annotation(Given):
    image_id: int
    category_id: int
    keypoints: tuple[float, ...] = ()


class _Dataset(Given):
    images: tuple[CocoImage, ...]
    annotations: tuple[_Annotation, ...]
    categories: tuple[_Category, ...]


def _read_coco(content: bytes) -> Iterator[MarkedImage]:
    try:
        dataset = _Dataset.model_validate(json.loads(content))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ContentError(f"no JSON: {error}") from error
    names = {category.id: category.keypoints for category in dataset.categories}
    for image in dataset.images:
        points = []
        for each in dataset.annotations:
            if each.image_id != image.id:
                continue
            labels = names.get(each.category_id, ())
            if len(each.keypoints) != 3 * len(labels):
                raise ContentError(
                    f"{image.file_name}: {len(each.keypoints)} numbers for {len(labels)} keypoints"
                )
            for label, (x, y, visible) in zip(
                labels, np.reshape(each.keypoints, (-1, 3)).tolist(), strict=True
            ):
                if visible > 0:
                    points.append((label, np.array([x, y])))
        yield MarkedImage(image.file_name, (image.width, image.height), tuple(points), ())
