"""CVAT for images XML 1.1 for annotated images: per person a box and a skeleton in one group."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from worldpose.formats.annotations.annotated_images import (
    CORNER,
    AnnotatedImage,
    AnnotatedPerson,
    ContentError,
    format_attributes,
    hull,
    read_attributes,
)

DEEPEST: Final = 16
"""Maximum nesting of elements; annotations have five."""


def read_xml(content: bytes) -> ElementTree.Element:
    """Return the root element of a document without a document type and thus without entities.

    Raises:
        ContentError: the document is not XML, declares a document type, or is nested deeply.
    """
    parser, builder = expat.ParserCreate(), ElementTree.TreeBuilder()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise ContentError(f"elements nested more than {DEEPEST} deep")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise ContentError("a document type declaration, which can hide other files and floods")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(content, True)
    except ContentError:
        raise
    # ValueError and LookupError: an encoding unknown to expat or Python.
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise ContentError(f"no XML: {error}") from error
    return builder.close()


BOX: Final = "person"
"""Label of boxes; must differ from the label of skeletons."""
SKELETON: Final = "pose"
"""Label of skeletons, whose points are the 17 joints of COCO."""


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
    """Read the images of a CVAT for images file, in its order.

    A skeleton and a box of one detection or one group are one person; a skeleton alone has the box
    around its points. Shapes of other kinds or labels are ignored.

    Raises:
        ContentError: the file has another format, or a shape is invalid.
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
    skeleton = SubElement(image, "skeleton", {"label": SKELETON, **common})
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
