"""Clicked points and drawn lines in files of CVAT, Label Studio, labelme, COCO and SoccerNet.

CVAT for video gives the images of its key frames; what it interpolates between them is no click.

Pixels follow this project: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element

import numpy as np
from pydantic import Field, TypeAdapter

from data_contracts.arrays import Floats
from worldpose.formats.annotations.annotated_images import (
    CORNER,
    CocoImage,
    ContentError,
    Given,
    decode_file,
    first_character,
)
from worldpose.formats.annotations.programs import Answer, read_xml

IMAGE_NAME: Final = re.compile(
    r"([^/\\?&=]+)\.(?:png|jpe?g|tiff?|bmp|webp)(?=$|[?&#])", re.IGNORECASE
)
"""The name of an image file at the end of a path, or in an address with a query."""
_NUMBER: Final = r"-?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_PAIRS: Final = re.compile(f"{_NUMBER},{_NUMBER}", re.ASCII)


@dataclass(frozen=True, eq=False)
class MarkedImage:
    """Labelled shapes in one image.

    Attributes:
        size: width, height [px]; None where the file has shares of them in place of pixels.
        points: label and (2,) pixel of every click, in the order of the file.
        lines: label and (points, 2) pixels of every drawn line.
        answers: people who marked the image, of whom one is read.
        areas: labels of lines that are polygons, which may outline other things than markings.
        left_out: kind and label of every shape that is not read.
    """

    name: str
    size: tuple[int, int] | None
    points: tuple[tuple[str, Floats], ...]
    lines: tuple[tuple[str, Floats], ...]
    answers: int = 1
    areas: frozenset[str] = frozenset()
    left_out: tuple[str, ...] = ()

    def of_size(self, size: tuple[int, int]) -> MarkedImage:
        """Return the image with pixels, in a size that the file may lack."""
        if self.size is not None:
            return self
        lines = tuple((label, share * np.array(size)) for label, share in self.lines)
        return replace(self, size=size, lines=lines)


def read_marked_images(path: Path) -> list[MarkedImage]:
    """Return images with shapes of the programs above; InputError without any."""
    max_bytes = 1 << 26  # maximum file size [bytes]

    def decode(content: bytes) -> list[MarkedImage]:
        decoders = {b"<": _read_cvat, b"[": _read_label_studio, b"{": _read_coco}
        begin = first_character(content)
        if begin not in decoders:
            raise ContentError("neither XML nor JSON")
        try:
            found = list(decoders[begin](content))
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ContentError(f"no JSON: {error}") from error
        name = path.stem if path.stem.isdecimal() else "picture"
        found = [image if image.name else replace(image, name=name) for image in found]
        if not any(image.points or image.lines for image in found):
            there = ", ".join(dict.fromkeys(each for image in found for each in image.left_out))
            raise ContentError(f"no labelled point or line{there and f', but {there}'}"[:200])
        _require_pixels(found, per_cent=begin == b"[")
        return [image for image in found if image.points or image.lines or image.left_out]

    expected = "labelled points of CVAT (XML 1.1), Label Studio, labelme or COCO, or SoccerNet's "
    expected += "lines"
    todo = "Export the clicks from the annotator in one of these forms."
    return decode_file(path, max_bytes, decode, expected, todo)


def _require_pixels(found: list[MarkedImage], *, per_cent: bool) -> None:
    """Raise ContentError if places are in another unit than the form's: per cent, or pixels."""
    own, smallest = [np.empty((0, 2))], np.inf
    for image in found:
        places = np.array(
            [*(at for _, at in image.points), *(p for _, at in image.lines for p in at)]
        )
        if image.size is None or not len(places):
            continue
        share = (places + CORNER) / image.size
        if len(share) > 2 and (np.abs(share - 0.5) > 1.0).any(axis=1).mean() > 0.5:
            found_share = f"{share.min():.3g} to {share.max():.3g} times the image's sides"
            raise ContentError(f"{image.name}: places of {found_share}: in another unit?")
        own.append(100.0 * share if per_cent else places + CORNER)
        smallest = min(smallest, *image.size)
    # Clicks of all images within the first pixel, or the first 100: few at a corner reach less far.
    all_own = np.concatenate(own)
    low, top = all_own.min(initial=np.inf), all_own.max(initial=-np.inf)
    is_share = top <= (1.1 if per_cent else 1.1 + CORNER)
    is_per_cent = not per_cent and smallest > 200 and 50.0 < top <= 100.0 + CORNER
    if len(all_own) > 1 and low > -0.1 and (is_share or is_per_cent):
        raise ContentError(f"places of {low:.3g} to {top:.3g} in all images: in another unit?")


def _read_cvat(content: bytes) -> Iterator[MarkedImage]:
    root = read_xml(content)
    if root.tag != "annotations":
        raise ContentError(f"the root is <{root.tag[:40]}>, not <annotations>")
    if root.find("track") is not None:
        yield from _read_tracks(root)
    for image in root.iter("image"):
        size = image.get("width"), image.get("height")
        shapes = [(shape.get("label", ""), shape) for shape in image.iter()]
        yield _marked(image.get("name", ""), size, shapes)


def _marked(
    name: str, size: tuple[str | None, str | None], shapes: Iterable[tuple[str, Element]]
) -> MarkedImage:
    """Return an image with the points and lines among labelled shapes of CVAT."""
    points: list[tuple[str, Floats]] = []
    lines: list[tuple[str, Floats]] = []
    areas: list[str] = []
    left_out: list[str] = []
    for label, shape in shapes:
        if shape.tag in ("box", "ellipse", "cuboid", "mask") and shape.get("outside") != "1":
            left_out.append(f"{shape.tag} of {label}")
        if shape.tag not in ("points", "polyline", "polygon") or shape.get("outside") == "1":
            continue
        text = shape.get("points", "")
        given = text.split(";")
        if not all(_PAIRS.fullmatch(pair.strip()) for pair in given):
            raise ContentError(f"{name}: {label}: points are {text[:60]!r}")
        pixels = np.array([pair.split(",") for pair in given], dtype=np.float64) - CORNER
        if shape.tag == "points":
            points += [(label, pixel) for pixel in pixels]
        else:
            lines.append((label, pixels))
            areas += [label] * (shape.tag == "polygon")
    try:
        width, height = (int(side or "") for side in size)
    except ValueError:
        raise ContentError(f"{name}: an image without width and height") from None
    marked = MarkedImage(name, (width, height), tuple(points), tuple(lines))
    return replace(marked, areas=frozenset(areas), left_out=tuple(left_out))


def _read_tracks(root: Element) -> Iterator[MarkedImage]:
    """Yield the key frames of CVAT for video, named by their frames in the video.

    CVAT counts the frames of the whole video; where some are before the task's first one, they
    count its chosen frames.
    """
    found: dict[int, list[tuple[str, Element]]] = {}
    for track in root.iter("track"):
        for shape in track:
            is_key = shape.get("keyframe", "1")  # the points of a skeleton have their own
            parts = list(shape) if shape.tag == "skeleton" else [shape]
            parts = [part for part in parts if part.get("keyframe", is_key) == "1"]
            if not parts or shape.get("outside") == "1":
                continue
            text = shape.get("frame", "")
            if not text.isdecimal() or len(text) > 9:
                raise ContentError(f"track {track.get('id')}: frame {text[:40]!r}")
            labels = [part.get("label", track.get("label", "")) for part in parts]
            found.setdefault(int(text), []).extend(zip(labels, parts, strict=True))
    first = root.findtext(".//start_frame") or "0"
    every = re.fullmatch(r"step=(\d{1,6})", (root.findtext(".//frame_filter") or "").strip())
    start = int(first) if first.isdecimal() else 0
    is_relative = min(found, default=start) < start
    size = root.findtext(".//original_size/width"), root.findtext(".//original_size/height")
    step = int(every[1]) if every else 1
    for number, shapes in sorted(found.items()):
        frame = start + number * step if is_relative else number
        yield _marked(f"frame_{frame:06d}", size, shapes)


_LABELS: Final = ("keypointlabels", "polygonlabels", "vectorlabels")
"""Label Studio's kinds of regions that are read: points, and lines as polygons or vectors."""


class _Task(Given):
    data: dict[str, Any]
    annotations: tuple[Answer, ...] = ()


class _Place(Given):
    x: float
    y: float


class _Value(Given):
    x: float = 0.0
    y: float = 0.0
    points: tuple[tuple[float, float], ...] = ()
    vertices: tuple[_Place, ...] = ()
    keypointlabels: tuple[str, ...] = Field(default=(), max_length=1)
    polygonlabels: tuple[str, ...] = Field(default=(), max_length=1)
    vectorlabels: tuple[str, ...] = Field(default=(), max_length=1)


class _Region(Given):
    type: str
    original_width: int = Field(ge=1)
    original_height: int = Field(ge=1)
    image_rotation: int = 0
    value: _Value

    def place(self) -> tuple[str, Floats]:
        """Return the label and the pixels (points, 2) of the picture as it was before turning."""
        label = getattr(self.value, self.type)
        if not label:
            raise ContentError(f"a region of {self.type} without a label")
        vertices = [(each.x, each.y) for each in self.value.vertices] or self.value.points
        x, y = np.array(vertices or [(self.value.x, self.value.y)], np.float64).T
        turned = {0: (x, y), 90: (y, 100.0 - x), 180: (100.0 - x, 100.0 - y), 270: (100.0 - y, x)}
        if self.image_rotation % 360 not in turned:
            raise ContentError(f"a picture turned by {self.image_rotation} degrees")
        size = np.array([self.original_width, self.original_height])
        share = np.stack(turned[self.image_rotation % 360], axis=-1)
        return label[0], share * size / 100.0 - CORNER


def _read_label_studio(content: bytes) -> Iterator[MarkedImage]:
    tasks = json.loads(content)
    if isinstance(tasks, list):
        tasks = [_full_task(task) for task in tasks]
    for number, task in enumerate(TypeAdapter(tuple[_Task, ...]).validate_python(tasks)):
        answers = [each for each in task.annotations if not each.was_cancelled]
        names = [value for value in task.data.values() if isinstance(value, str)]
        names.sort(key=lambda name: IMAGE_NAME.search(name) is None)
        name = names[0] if names else f"task {number}"
        given = Answer.choose(answers).result
        regions = [_Region.model_validate(each) for each in given if each.get("type") in _LABELS]
        other = [each for each in given if re.search("labels$", str(each.get("type")))]
        left_out = tuple(_describe_other(each) for each in other if each["type"] not in _LABELS)
        sizes = {(region.original_width, region.original_height) for region in regions}
        if len(sizes) > 1:
            raise ContentError(f"{name}: regions of images of {len(sizes)} sizes")
        shapes = [(region.type, *region.place()) for region in regions]
        points = ((label, at[0]) for kind, label, at in shapes if kind == "keypointlabels")
        lines = ((label, at) for kind, label, at in shapes if kind != "keypointlabels")
        size = sizes.pop() if sizes else None
        areas = frozenset(label for kind, label, _ in shapes if kind == "polygonlabels")
        yield MarkedImage(name, size, tuple(points), tuple(lines), len(answers), areas, left_out)


def _describe_other(region: dict[str, Any]) -> str:
    value = region.get("value")
    labels = value.get(region["type"]) if isinstance(value, dict) else None
    return f"{region['type']} of {', '.join(map(str, labels or ['no label']))}"


def _full_task(task: Any) -> Any:  # noqa: ANN401
    """Return a task of the export JSON as it is, and one of JSON_MIN in that form."""
    if not isinstance(task, dict) or "data" in task:
        return task
    regions = [
        {
            "type": kind,
            "original_width": each.get("original_width"),
            "original_height": each.get("original_height"),
            "image_rotation": each.get("image_rotation", 0),
            "value": each,
        }
        for entry in task.values()
        if isinstance(entry, list)
        for each in entry
        if isinstance(each, dict)
        for kind in each
        if str(kind).endswith("labels")
    ]
    names = {key: value for key, value in task.items() if isinstance(value, str)}
    return {"data": names, "annotations": [{"result": regions}]}


class _Category(Given):
    id: int
    name: str = ""
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
    given = json.loads(content)
    theirs = {*map(str.lower, SOCCERNET_MARKINGS)}
    if isinstance(given, dict) and theirs & {name.strip().lower() for name in given}:
        yield _read_soccernet("", given)  # a number may name its file
        return
    # A task of Label Studio alone; data sets may have more keys.
    if isinstance(given, dict) and "data" in given and "images" not in given:
        yield from _read_label_studio(json.dumps([given]).encode())
        return
    if isinstance(given, dict) and "images" not in given:
        if "shapes" in given:
            yield _read_labelme(given)
            return
        _require_known(given)
    if isinstance(given, dict) and isinstance(given.get("annotations"), list):
        marked = [each for each in given["annotations"] if isinstance(each, dict)]
        if any(isinstance(each.get("lines"), dict) for each in marked):
            yield from _read_game_state({**given, "annotations": marked})
            return
    dataset = _Dataset.model_validate(given)
    names = {category.id: category.keypoints for category in dataset.categories}
    called = {category.id: category.name or str(category.id) for category in dataset.categories}
    listed = {image.id for image in dataset.images}
    lost = sum(each.image_id not in listed for each in dataset.annotations)
    yield MarkedImage("", None, (), (), left_out=("annotation of an image not listed",) * lost)
    for image in dataset.images:
        points = []
        left_out = []
        for each in dataset.annotations:
            if each.image_id != image.id:
                continue
            labels = names.get(each.category_id, ())
            if not each.keypoints:
                left_out.append(f"annotation without keypoints of {called.get(each.category_id)}")
            if len(each.keypoints) != 3 * len(labels):
                what = f"{len(labels)} keypoints of category {each.category_id}"
                raise ContentError(f"{image.file_name}: {len(each.keypoints)} numbers for {what}")
            for label, (x, y, visible) in zip(
                labels, np.reshape(each.keypoints, (-1, 3)).tolist(), strict=True
            ):
                if visible > 0:
                    points.append((label, np.array([x, y])))
        size = image.width, image.height
        yield MarkedImage(image.file_name, size, tuple(points), (), left_out=tuple(left_out))


class _Shape(Given):
    label: str
    shape_type: str = "polygon"
    points: tuple[tuple[float, float], ...]


def _read_labelme(given: dict[str, Any]) -> MarkedImage:
    """Return the only image of a file of labelme, whose shapes are CVAT's by other names."""
    tags = {"point": "points", "line": "polyline", "linestrip": "polyline", "polygon": "polygon"}
    tags |= {"rectangle": "box", "circle": "ellipse"}
    shapes = []
    for each in TypeAdapter(tuple[_Shape, ...]).validate_python(given["shapes"]):
        places = ";".join(f"{x},{y}" for x, y in each.points)
        shapes.append((each.label, Element(tags.get(each.shape_type, "mask"), points=places)))
    size = str(given.get("imageWidth")), str(given.get("imageHeight"))
    return _marked(str(given.get("imagePath", "")), size, shapes)


def _require_known(given: dict[str, Any]) -> None:
    """Raise ContentError for a file that lacks image sizes, or where in a pixel its places are."""
    nested = {key for part in given.values() if isinstance(part, dict) for key in part}
    is_via = "regions" in nested or "_via_img_metadata" in given
    if is_via or {"objects", "size"} <= given.keys():
        program = "VIA, which states no image sizes" if is_via else "Supervisely"
        raise ContentError(f"a file of {program}; convert it to COCO keypoints that have names")


class _Share(Given):
    x: float
    y: float


def _read_game_state(given: dict[str, Any]) -> Iterator[MarkedImage]:
    """Yield the images of SoccerNet's Labels-GameState.json; its first image is frame 0."""
    listed = TypeAdapter(tuple[dict[str, Any], ...]).validate_python(given.get("images"))
    numbers = {}
    for image in listed:
        digits = re.search(r"(\d{1,9})\.\w+$", str(image.get("file_name")))
        if digits is None:
            raise ContentError(f"an image without a number: {image.get('file_name')!r:.40}")
        numbers[str(image.get("image_id"))] = int(digits[1])
    for each in given["annotations"]:
        lines, image_id = each.get("lines"), str(each.get("image_id"))
        if lines and image_id not in numbers:
            raise ContentError(f"lines of image {image_id:.40}, which is not there")
        if lines:
            number = numbers[image_id] - min(numbers.values())
            yield _read_soccernet(f"frame_{number:06d}", lines)


def _read_soccernet(image: str, given: dict[str, Any]) -> MarkedImage:
    """Return the image of SoccerNet's lines: shares of width and height by names of markings."""
    lines = []
    for name, places in TypeAdapter(dict[str, tuple[_Share, ...]]).validate_python(given).items():
        # Annotators drag ends past the border, where nothing is visible.
        inside = [(at.x, at.y) for at in places if 0.0 <= at.x <= 1.0 and 0.0 <= at.y <= 1.0]
        if inside and "unknown" not in name.lower():  # SoccerNet's word for lines of no name
            lines.append((name, np.array(inside)))
        elif not inside and any(max(at.x, at.y) > 2.0 for at in places):
            raise ContentError(f"{name}: places in pixels; SoccerNet's are shares, from 0 to 1")
    return MarkedImage(image, None, (), tuple(lines))


def _soccernet_markings() -> dict[str, str]:
    names = {
        "Side line top": "touch_line_far",
        "Side line bottom": "touch_line_near",
        "Middle line": "halfway_line",
        "Circle central": "center_circle",
    }
    for side, left_post, right_post in (("left", "near", "far"), ("right", "far", "near")):
        names[f"Side line {side}"] = f"goal_line_{side}"
        names[f"Circle {side}"] = f"penalty_arc_{side}"
        for theirs, ours in (("Big", "penalty_area"), ("Small", "goal_area")):
            for part, place in (("main", "front"), ("top", "far"), ("bottom", "near")):
                names[f"{theirs} rect. {side} {part}"] = f"{ours}_{side}_{place}"
        names[f"Goal {side} crossbar"] = f"crossbar_{side}"
        names[f"Goal {side} post left"] = f"goal_post_{side}_{left_post}"
        names[f"Goal {side} post right"] = f"goal_post_{side}_{right_post}"
    return names


SOCCERNET_MARKINGS: Final = _soccernet_markings()
"""Names of the pitch template by SoccerNet's names."""
