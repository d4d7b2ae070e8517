"""Frames with labelled people, as COCO keypoints data sets on disk."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.errors import InputError


class _Given(BaseModel):
    """Part of a foreign data set; unknown keys are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class _Image(_Given):
    id: int
    file_name: str = Field(min_length=1)


class _Person(_Given):
    image_id: int
    bbox: tuple[float, float, float, float]
    keypoints: Annotated[tuple[float, ...], Field(min_length=51, max_length=51)] | None = None
    iscrowd: int = 0


class _Dataset(_Given):
    images: tuple[_Image, ...]
    annotations: tuple[_Person, ...]


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """One image and the people in it.

    Attributes:
        path: of the image.
        boxes: (people, 4) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel.
        keypoints: (people, 17, 2) COCO-17 [px]; NaN where not labelled.
        visible: (people, 17) int8: 2 visible, 1 occluded or outside of the image, 0 not labelled.
        ignored: (people,) people too occluded or too small, or groups: detections of them count
            neither as true nor as false positives.
    """

    path: Path
    boxes: Floats
    keypoints: Floats
    visible: NDArray[np.int8]
    ignored: NDArray[np.bool_]


def read_labels(annotations: Path, pictures: Path | None = None) -> list[LabelledPicture]:
    """Return the images of a COCO keypoints data set, in the order of their ids.

    `iscrowd` 1 marks ignored people. Boxes are x, y, width, height in the pixels of the keypoints,
    which begin at the centre of the top-left pixel.

    Args:
        annotations: the JSON file.
        pictures: the folder of the images; the folder of the JSON file if None.

    Raises:
        InputError: the file is no COCO keypoints data set, or an image lies outside of the folder.
    """
    folder = annotations.parent if pictures is None else pictures

    def refusal(expected: str, found: str) -> InputError:
        return InputError(
            str(annotations),
            expected=expected,
            found=found,
            todo="Export the labels again as COCO keypoints of 17 joints.",
        )

    try:
        dataset = _Dataset.model_validate_json(annotations.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        found = f"{'.'.join(map(str, first['loc']))}: {first['msg']}".removeprefix(": ")
        raise refusal("a COCO keypoints data set", found) from error
    except OSError as error:
        raise refusal("a COCO keypoints data set", f"{type(error).__name__}: {error}") from error
    people: dict[int, list[_Person]] = {image.id: [] for image in dataset.images}
    for person in dataset.annotations:
        if person.image_id not in people:
            raise refusal("an image for each annotation", f"none of id {person.image_id}")
        people[person.image_id].append(person)
    images = sorted(dataset.images, key=lambda image: image.id)
    read = [_picture(folder, image, people[image.id]) for image in images]
    for picture in read:
        if not picture.path.resolve().is_relative_to(folder.resolve()):
            raise refusal("pictures within the data set's folder", str(picture.path))
    return read


def write_labels(
    annotations: Path, pictures: Sequence[LabelledPicture], size: tuple[int, int]
) -> None:
    """Write a COCO keypoints data set; image names are relative to the file's folder.

    Args:
        annotations: the JSON file.
        pictures: within its folder.
        size: width, height of the images [px].
    """
    images: list[dict[str, Any]] = []
    people: list[dict[str, Any]] = []
    for number, picture in enumerate(pictures):
        name = picture.path.relative_to(annotations.parent).as_posix()
        images.append({"id": number, "file_name": name, "width": size[0], "height": size[1]})
        rows = zip(picture.boxes, picture.keypoints, picture.visible, picture.ignored, strict=True)
        for box, keypoints, visible, ignored in rows:
            people.append(
                {
                    "id": len(people) + 1,
                    "image_id": number,
                    "category_id": 1,
                    "iscrowd": int(ignored),
                    **_annotation(box, keypoints, visible),
                }
            )
    category = {"id": 1, "name": "person", "keypoints": list(COCO17)}
    dataset = {"images": images, "annotations": people, "categories": [category]}
    annotations.write_text(json.dumps(dataset, separators=(",", ":")) + "\n", encoding="utf-8")


def _annotation(box: Floats, keypoints: Floats, visible: NDArray[np.int8]) -> dict[str, Any]:
    x, y, right, bottom = np.round(box, 2).tolist()
    triples = np.column_stack([np.nan_to_num(np.round(keypoints, 2)), visible])
    return {
        "bbox": [x, y, round(right - x, 2), round(bottom - y, 2)],
        "area": round((right - x) * (bottom - y), 2),
        "num_keypoints": int((visible > 0).sum()),
        "keypoints": [value for a, b, v in triples.tolist() for value in (a, b, int(v))],
    }


def _picture(folder: Path, image: _Image, people: Sequence[_Person]) -> LabelledPicture:
    boxes = np.array([person.bbox for person in people], dtype=np.float64).reshape(-1, 4)
    given = [person.keypoints or (0.0,) * 51 for person in people]
    triples = np.array(given, dtype=np.float64).reshape(len(people), 17, 3)
    visible = triples[..., 2].astype(np.int8)
    return LabelledPicture(
        path=folder / image.file_name,
        boxes=np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]]),
        keypoints=np.where(visible[..., None] > 0, triples[..., :2], np.nan),
        visible=visible,
        ignored=np.array([bool(person.iscrowd) for person in people], dtype=np.bool_),
    )
