"""Label Studio JSON for annotated images: per person a rectangle with child keypoints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.formats.annotations.annotated_images import (
    CORNER,
    AnnotatedImage,
    AnnotatedPerson,
    ContentError,
    format_attributes,
    read_attributes,
)

HIDDEN: Final = "hidden"
"""Note at an occluded keypoint: Label Studio has no field for that."""
POINT: Final = 0.3
"""Displayed size of a keypoint [% of the image width]."""


class _Given(BaseModel):
    """Part of an external file; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class _Value(_Given):
    x: float
    y: float
    width: float = Field(default=0.0, ge=0)
    height: float = Field(default=0.0, ge=0)
    rotation: float = 0.0
    keypointlabels: tuple[str, ...] = ()


class _Meta(_Given):
    text: tuple[str, ...] = ()


class _Region(_Given):
    id: str
    type: str
    original_width: int = Field(ge=1)
    original_height: int = Field(ge=1)
    image_rotation: float = 0.0
    value: _Value
    meta: _Meta = _Meta()
    parent: str | None = Field(default=None, alias="parentID")


class _Answer(_Given):
    result: tuple[dict[str, Any], ...] = ()
    was_cancelled: bool = False


class _Data(_Given):
    image: str = Field(min_length=1)
    width: int = Field(ge=1)
    height: int = Field(ge=1)


class _Task(_Given):
    data: _Data
    annotations: tuple[_Answer, ...] = ()
    predictions: tuple[_Answer, ...] = ()


def label_studio_bytes(pictures: Sequence[AnnotatedImage]) -> bytes:
    """Write Label Studio tasks, with the detections as predictions."""
    tasks = [
        {
            "data": {
                "image": picture.name,
                "width": picture.size[0],
                "height": picture.size[1],
            },
            "predictions": [{"model_version": "worldpose", "result": _result(picture)}],
        }
        for picture in pictures
    ]
    return (json.dumps(tasks, separators=(",", ":"), allow_nan=False) + "\n").encode()


def read_label_studio(content: bytes) -> list[AnnotatedImage]:
    """Read the images of a Label Studio export, in its order.

    For each task the last annotation that was not cancelled is used, or else the last prediction. A
    keypoint belongs to its parent rectangle, or else to the only one around it.

    Raises:
        ContentError: the file has another format, or a region is invalid.
    """
    return [_read(task) for task in TypeAdapter(tuple[_Task, ...]).validate_json(content)]


def _result(picture: AnnotatedImage) -> list[dict[str, Any]]:
    regions: list[dict[str, Any]] = []
    width, height = picture.size
    percent = 100.0 / np.array(picture.size, dtype=np.float64)
    common = {
        "to_name": "image",
        "original_width": width,
        "original_height": height,
        "image_rotation": 0,
    }
    for number, person in enumerate(picture.people):
        (x, y), (wide, high) = (
            ((person.box[:2] + CORNER) * percent).tolist(),
            ((person.box[2:] - person.box[:2]) * percent).tolist(),
        )
        regions.append(
            {
                "id": f"person{number}",
                "type": "rectanglelabels",
                "from_name": "box",
                **common,
                "value": {
                    "x": x,
                    "y": y,
                    "width": wide,
                    "height": high,
                    "rotation": 0,
                    "rectanglelabels": ["person"],
                },
                "meta": {"text": [f"{k}={v}" for k, v in format_attributes(person).items()]},
            }
        )
        for joint, xy, visible in zip(COCO17, person.keypoints, person.visible, strict=True):
            if not visible:
                continue
            x, y = ((xy + CORNER) * percent).tolist()
            regions.append(
                {
                    "id": f"person{number}.{joint}",
                    "type": "keypointlabels",
                    "from_name": "joint",
                    **common,
                    "parentID": f"person{number}",
                    "value": {"x": x, "y": y, "width": POINT, "keypointlabels": [joint]},
                    **({"meta": {"text": [HIDDEN]}} if visible == 1 else {}),
                }
            )
    return regions


def _read(task: _Task) -> AnnotatedImage:
    size = (task.data.width, task.data.height)
    name = task.data.image
    given = [each for each in task.annotations if not each.was_cancelled] or [*task.predictions]
    shapes = [
        _Region.model_validate(region)
        for region in (given[-1].result if given else ())
        if region.get("type") in ("rectanglelabels", "keypointlabels")
    ]
    for region in shapes:
        if (region.original_width, region.original_height) != size:
            raise ContentError(f"{name}: a region of an image of another size")
        if region.image_rotation or region.value.rotation:
            raise ContentError(f"{name}: a region that is rotated")
    pixels = np.array(size, dtype=np.float64) / 100.0
    boxes: dict[str, tuple[_Region, Floats]] = {}
    for region in shapes:
        if region.type == "rectanglelabels":
            value = region.value
            begin = np.array([value.x, value.y]) * pixels - CORNER
            box = np.concatenate([begin, begin + np.array([value.width, value.height]) * pixels])
            if region.id in boxes:
                raise ContentError(f"{name}: two regions have one id")
            boxes[region.id] = (region, _round_pixels(box))
    keypoints = {owner: np.full((17, 2), np.nan) for owner in boxes}
    visible = {owner: np.zeros(17, dtype=np.int8) for owner in boxes}
    for region in shapes:
        if region.type == "keypointlabels":
            place = _round_pixels(np.array([region.value.x, region.value.y]) * pixels - CORNER)
            owner = _owner(name, region, place, {key: box for key, (_, box) in boxes.items()})
            labels = region.value.keypointlabels or ("",)
            if len(labels) > 1:
                raise ContentError(f"{name}: a point with {len(labels)} labels")
            joint = labels[0]
            if joint not in COCO17:
                raise ContentError(f"{name}: COCO-17 has no joint {joint[:40]!r}")
            k = COCO17.index(joint)
            if visible[owner][k]:
                raise ContentError(f"{name}: two points are the {joint} of one person")
            keypoints[owner][k] = place
            visible[owner][k] = 1 if HIDDEN in region.meta.text else 2
    people = (
        AnnotatedPerson(
            box,
            keypoints[owner],
            visible[owner],
            **read_attributes(dict(text.partition("=")[::2] for text in region.meta.text)),
        )
        for owner, (region, box) in boxes.items()
    )
    return AnnotatedImage(name, size, tuple(people))


def _owner(name: str, region: _Region, place: Floats, boxes: dict[str, Floats]) -> str:
    if region.parent in boxes:
        return region.parent
    around = [
        owner
        for owner, box in boxes.items()
        if (box[:2] <= place).all() and (place <= box[2:]).all()
    ]
    if len(around) != 1:
        raise ContentError(
            f"{name}: a point lies in {len(around)} rectangles and is the child of none"
        )
    return around[0]


def _round_pixels(pixels: Floats) -> Floats:
    """Round to single precision, as stored: errors from percentages are far smaller."""
    return pixels.astype(np.float32).astype(np.float64)
