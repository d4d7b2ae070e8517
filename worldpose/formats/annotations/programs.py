"""Files of annotation programs for annotated images: CVAT for images XML 1.1, Label Studio JSON.

Per person, CVAT has a box and a skeleton in one group, Label Studio a rectangle with keypoints.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.formats.annotations.annotated_images import (
    CORNER,
    AnnotatedImage,
    AnnotatedPerson,
    ContentError,
    Given,
    format_attributes,
    hull,
    read_attributes,
)
from worldpose.formats.files import parse_xml


def read_xml(content: bytes) -> Element:
    """Return the root element of a document; ContentError where `parse_xml` refuses it."""
    try:
        return parse_xml(content)
    except ValueError as error:
        raise ContentError(str(error)) from error


BOX: Final = "person"
"""Label of boxes; must differ from the label of skeletons."""


def cvat_bytes(pictures: Sequence[AnnotatedImage]) -> bytes:
    """Write a CVAT for images file."""
    root = Element("annotations")
    SubElement(root, "version").text = "1.1"
    for number, picture in enumerate(pictures):
        width, height = map(str, picture.size)
        where = {"id": str(number), "name": picture.name, "width": width, "height": height}
        image = SubElement(root, "image", where)
        for group, person in enumerate(picture.people, 1):
            _write(image, group, person)
    ElementTree.indent(root)
    content: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def read_cvat(content: bytes) -> list[AnnotatedImage]:
    """Read the images of a CVAT for images file, in its order; ContentError if it is none.

    A skeleton and a box of one detection or one group are one person; a skeleton alone has the box
    around its points. Shapes of other kinds or labels are ignored.
    """
    root = read_xml(content)
    if root.tag != "annotations":
        raise ContentError(f"the root is <{root.tag[:40]}>, not <annotations>")
    if root.find("track") is not None:
        raise ContentError("tracks: export as `CVAT for images`, not `for video`")
    return [_read_image(image) for image in root.iter("image")]


def _write(image: Element, group: int, person: AnnotatedPerson) -> None:
    source = "auto" if person.origin == "automatic" else "manual"
    common = {"source": source, "z_order": "0", "group_id": str(group)}
    corners = zip(("xtl", "ytl", "xbr", "ybr"), (person.box + CORNER).tolist(), strict=True)
    shape = {name: str(value) for name, value in corners}
    box = SubElement(image, "box", {"label": BOX, "occluded": "0", **shape, **common})
    skeleton_label = "pose"  # its points are the 17 joints of COCO
    skeleton = SubElement(image, "skeleton", {"label": skeleton_label, **common})
    middle = (person.box[:2] + person.box[2:]) / 2  # position of missing keypoints
    for joint, xy, visible in zip(COCO17, person.keypoints, person.visible, strict=True):
        x, y = ((xy if visible else middle) + CORNER).tolist()
        SubElement(
            skeleton,
            "points",
            {
                "label": joint,
                "source": source,
                "occluded": str(int(visible == 1)),
                "outside": str(int(visible == 0)),
                "points": f"{x},{y}",
            },
        )
    for name, value in format_attributes(person).items():
        for element in (box, skeleton):
            SubElement(element, "attribute", {"name": name}).text = value


def _read_image(image: Element) -> AnnotatedImage:
    name, size = (
        _require_attribute(image, "name"),
        (_whole(image, "width"), _whole(image, "height")),
    )
    boxes: dict[tuple[str, str], Element] = {}
    for key, box in _of_label(image, "box", BOX):
        if key in boxes:
            raise ContentError(f"{name}: two boxes of {' '.join(key)}")
        boxes[key] = box
    people = []
    taken = set()
    for key, skeleton in _of_label(image, "skeleton", None):
        if key in taken:
            raise ContentError(f"{name}: two skeletons of {' '.join(key)}")
        taken.add(key)
        keypoints, visible = _skeleton(skeleton)
        own = boxes.pop(key, None)
        if own is None and not visible.any():
            continue  # no keypoints, so no person
        corners = hull(keypoints) if own is None else _box(own)
        attributes = read_attributes(_attributes(skeleton))
        people.append(AnnotatedPerson(corners, keypoints, visible, **attributes))
    people += [
        AnnotatedPerson(_box(box), *_nowhere(), **read_attributes(_attributes(box)))
        for box in boxes.values()
    ]
    return AnnotatedImage(name, size, tuple(people))


def _of_label(
    image: Element, tag: str, label: str | None
) -> Iterator[tuple[tuple[str, str], Element]]:
    """Yield shapes, each with the identifier that the two shapes of a person share."""
    for number, element in enumerate(image.findall(tag)):
        if label is not None and element.get("label") != label:
            continue
        detection = _attributes(element).get("detection")
        group = element.get("group_id", "0")
        if detection:
            yield ("detection", detection), element
        elif group != "0":
            yield ("group", group), element
        else:
            yield (tag, str(number)), element


def _attributes(element: Element) -> dict[str, str]:
    return {
        attribute.get("name", ""): (attribute.text or "").strip()
        for attribute in element.findall("attribute")
    }


def _box(element: Element) -> Floats:
    if element.get("rotation", "0") not in ("0", "0.0", "0.00"):
        raise ContentError("a box that is rotated")
    given = [_number(_require_attribute(element, name)) for name in ("xtl", "ytl", "xbr", "ybr")]
    box = np.array(given) - CORNER
    if (box[2:] < box[:2]).any():
        raise ContentError("a box of negative size")
    return box


def _skeleton(element: Element) -> tuple[Floats, NDArray[np.int8]]:
    keypoints, visible = _nowhere()
    for point in element.findall("points"):
        joint = _require_attribute(point, "label")
        if joint not in COCO17:
            raise ContentError(f"COCO-17 has no joint {joint[:40]!r}")
        if point.get("outside", "0") == "1":
            continue
        place = _require_attribute(point, "points").split(",")
        if len(place) != 2:
            raise ContentError(f"{joint} has not one place")
        k = COCO17.index(joint)
        keypoints[k] = [_number(value) - CORNER for value in place]
        visible[k] = 1 if point.get("occluded") == "1" else 2
    return keypoints, visible


def _nowhere() -> tuple[Floats, NDArray[np.int8]]:
    """Return missing keypoints."""
    return np.full((17, 2), np.nan), np.zeros(17, dtype=np.int8)


def _require_attribute(element: Element, name: str) -> str:
    value = element.get(name)
    if not value:
        raise ContentError(f"<{element.tag}> has no {name}")
    return value


def _whole(element: Element, name: str) -> int:
    value = _number(_require_attribute(element, name))
    if value < 1 or value != int(value):
        raise ContentError(f"<{element.tag}> has {name} {value}")
    return int(value)


def _number(text: str) -> float:
    try:
        value = float(text[:40])
    except ValueError:
        raise ContentError(f"{text[:40]!r} for a number") from None
    if not np.isfinite(value):
        raise ContentError("a number that is not finite")
    return value


HIDDEN: Final = "hidden"
"""Note at an occluded keypoint: Label Studio has no field for that."""


class _Value(Given):
    x: float
    y: float
    width: float = Field(default=0.0, ge=0)
    height: float = Field(default=0.0, ge=0)
    rotation: float = 0.0
    keypointlabels: tuple[str, ...] = ()


class _Meta(Given):
    text: tuple[str, ...] = ()


class _Region(Given):
    id: str
    type: str
    original_width: int = Field(ge=1)
    original_height: int = Field(ge=1)
    image_rotation: float = 0.0
    value: _Value
    meta: _Meta = _Meta()
    parent: str | None = Field(default=None, alias="parentID")


class Answer(Given):
    """Regions that one annotator, or a detector, drew in an image."""

    result: tuple[dict[str, Any], ...] = ()
    was_cancelled: bool = False
    ground_truth: bool | None = None

    @classmethod
    def choose(cls, given: Sequence[Answer]) -> Answer:
        """Return the answer that counts as truth, else the last one; an empty one without any."""
        return next((each for each in given if each.ground_truth), [cls(), *given][-1])


class _Data(Given):
    image: str = Field(min_length=1)
    width: int = Field(ge=1)
    height: int = Field(ge=1)


class _Task(Given):
    data: _Data
    annotations: tuple[Answer, ...] = ()
    predictions: tuple[Answer, ...] = ()


def label_studio_bytes(pictures: Sequence[AnnotatedImage]) -> bytes:
    """Write Label Studio tasks, with the detections as predictions."""
    tasks = [
        {
            "data": {"image": picture.name, "width": picture.size[0], "height": picture.size[1]},
            "predictions": [{"model_version": "worldpose", "result": _result(picture)}],
        }
        for picture in pictures
    ]
    return (json.dumps(tasks, separators=(",", ":"), allow_nan=False) + "\n").encode()


def read_label_studio(content: bytes) -> list[AnnotatedImage]:
    """Read the images of a Label Studio export, in its order; ContentError if it is none.

    For each task the last annotation that was not cancelled is used, or else the last prediction. A
    keypoint belongs to its parent rectangle, or else to the only one around it.
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
    point_size = 0.3  # displayed, of the image width [%]
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
                    "value": {"x": x, "y": y, "width": point_size, "keypointlabels": [joint]},
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
        for region in Answer.choose(given).result
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
