"""Frames with labelled people, as COCO keypoints data sets on disk."""

from __future__ import annotations

import json
import logging
import re
import tempfile
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from data_contracts.arrays import Flags, Floats, Image
from data_contracts.conventions import COCO17
from worldpose.detection.models import load_detectors, load_pose
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.suppression import combine_boxes, fuse
from worldpose.detection.views import as_frame_detector
from worldpose.errors import InputError, UsageError
from worldpose.formats.annotations.annotated_images import Given
from worldpose.formats.keypoint_sets import PointOrder, order_by_names
from worldpose.video.folder import declared_size, decode_image, open_video

LOG = logging.getLogger("worldpose.finetune")
_PEOPLE = re.compile("person|people|human|pedestrian|player|keeper|goalie|referee|umpire|coach")
"""Words in the names of categories of people."""


class _Image(Given):
    id: int
    file_name: str = Field(min_length=1)
    width: int | None = None
    height: int | None = None


_Side = Annotated[float, Field(ge=0.0)]


class _Person(Given):
    image_id: int
    category_id: int | None = None
    bbox: tuple[float, float, _Side, _Side]
    keypoints: tuple[float, ...] | None = None
    iscrowd: int = 0


class _Category(Given):
    id: int
    name: str | None = None
    supercategory: str | None = None
    keypoints: tuple[str, ...] | None = None

    @property
    def is_of_people(self) -> bool:
        is_named = _PEOPLE.search((self.name or "").lower()) is not None
        return bool(self.keypoints) or is_named or self.supercategory in ("person", "people")


class _Dataset(Given):
    images: tuple[_Image, ...]
    annotations: tuple[_Person, ...]
    categories: tuple[_Category, ...] = ()


@dataclass(frozen=True, eq=False)
class LabelledPicture:
    """One image and the people in it.

    Attributes:
        path: path of the image.
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
    ignored: Flags


def read_labels(annotations: Path, pictures: Path | None = None) -> list[LabelledPicture]:
    """Return the images of a COCO keypoints data set, in the order of their ids.

    `iscrowd` 1 marks ignored people. Boxes are x, y, width, height in the pixels of the keypoints,
    which begin at the centre of the top-left pixel. The categories name the order of keypoints;
    annotations of categories without keypoints or a name of people are left out, and said.

    Images are in the folder `pictures`, by default that of the JSON file. InputError also if one
    lies outside of it or has another size.
    """
    folder = annotations.parent if pictures is None else pictures

    def refusal(expected: str, found: str, key: str = "") -> InputError:
        return InputError(
            f"{annotations}{key and ': '}{key}",
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
    people = _people(annotations, dataset, refusal)
    images = sorted(dataset.images, key=lambda image: image.id)
    read = [_picture(folder, image, people[image.id]) for image in images]
    for image, picture in zip(images, read, strict=True):
        if not picture.path.resolve().is_relative_to(folder.resolve()):
            raise refusal("images within the folder of the data set", str(picture.path))
        if not (image.width and image.height and picture.path.is_file()):
            continue
        size_on_disk = declared_size(np.fromfile(picture.path, np.uint8))
        if size_on_disk not in (None, (image.width, image.height)):
            found = "{} x {} in {}".format(*size_on_disk, picture.path)
            where = f"images of id {image.id}"
            raise refusal(f"an image of {image.width} x {image.height}", found, where)
    return read


def _people(
    path: Path, dataset: _Dataset, refusal: Callable[..., InputError]
) -> dict[int, list[tuple[_Person, Floats]]]:
    """Return people by image, each with COCO-17's joints (17, 3) x, y, v."""
    people: dict[int, list[tuple[_Person, Floats]]] = {image.id: [] for image in dataset.images}
    if len(people) < len(dataset.images):
        raise refusal("images of different ids", f"{len(dataset.images)} of {len(people)} ids")
    orders, known = _orders(path, dataset.categories), {each.id for each in dataset.categories}
    left_out: Counter[str] = Counter()
    for number, person in enumerate(dataset.annotations):
        key, category = f"annotations.{number}", person.category_id if known else None
        if person.image_id not in people:
            raise refusal("an image for each annotation", f"none of id {person.image_id}", key)
        if category is None and len(known) == 1:
            (category,) = known
        if known and category not in known:
            expected = f"one of {', '.join(map(str, sorted(known)))}"
            raise refusal(expected, f"{category}", f"{key}.category_id")
        if category not in orders:
            left_out.update(str(c.name or c.id) for c in dataset.categories if c.id == category)
            continue
        order, size = orders[category]
        given = np.array(person.keypoints or (0.0,) * 3 * size)
        if len(given) != 3 * size or not np.isin(given[2::3], (0.0, 1.0, 2.0)).all():
            expected = f"x, y and v = 0, 1 or 2 of {size} points"
            raise refusal(expected, f"{given.tolist()}", f"{key}.keypoints")
        places = np.array(order.joints)
        joints = np.where(places[:, None] >= 0, given.reshape(size, 3)[places], 0.0)
        people[person.image_id].append((person, joints))
    if left_out:
        listed = ", ".join(f"{count} of {name}" for name, count in left_out.items())
        LOG.warning("%s: left out annotations that are no people: %s", path, listed)
    return people


def _orders(
    path: Path, categories: Sequence[_Category]
) -> Mapping[int | None, tuple[PointOrder, int]]:
    """Return order and number of keypoints by category of people; by None without categories.

    InputError if none of several categories is of people, or its keypoints are others.
    """
    usual = order_by_names(str(path), COCO17), len(COCO17)
    people = [each for each in categories if each.is_of_people or len(categories) == 1]
    if categories and not people:
        raise InputError(
            f"{path}: categories",
            expected="a category with keypoints, or of a name such as person or player",
            found=", ".join(str(each.name or each.id) for each in categories),
            todo="Name the category of people so.",
        )
    orders: dict[int | None, tuple[PointOrder, int]] = {} if people else {None: usual}
    for each in people:
        names = each.keypoints or ()
        where = f"{path}: category {each.name or each.id}"
        orders[each.id] = (order_by_names(where, names), len(names)) if names else usual
    return orders


def write_labels(
    annotations: Path, pictures: Sequence[LabelledPicture], size: tuple[int, int]
) -> None:
    """Write a COCO keypoints data set; image names are relative to the file's folder.

    Pictures within it have a width, height [px].
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


def _picture(
    folder: Path, image: _Image, people: Sequence[tuple[_Person, Floats]]
) -> LabelledPicture:
    boxes = np.array([person.bbox for person, _ in people], dtype=np.float64).reshape(-1, 4)
    triples = np.array([points for _, points in people], dtype=np.float64).reshape(-1, 17, 3)
    visible = triples[..., 2].astype(np.int8)
    return LabelledPicture(
        path=folder / image.file_name,
        boxes=np.column_stack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]]),
        keypoints=np.where(visible[..., None] > 0, triples[..., :2], np.nan),
        visible=visible,
        ignored=np.array([bool(person.iscrowd) for person, _ in people], dtype=np.bool_),
    )


def read_picture(path: Path) -> Image:
    """Return an image (height, width, 3) in RGB; InputError if the file is none."""
    try:
        image = decode_image(np.fromfile(path, np.uint8))
    except OSError:
        image = None
    if image is None:
        todo = "Put the images of the data set where its annotations say."
        raise InputError(str(path), "a readable image", "a missing or unreadable file", todo)
    return image


class PictureCache:
    """Images by path, at most `most` bytes in a cache that evicts the least recently used."""

    def __init__(self, most: int = 3 << 30) -> None:
        self._most, self._size = most, 0
        self._kept: OrderedDict[Path, Image] = OrderedDict()

    def __getitem__(self, path: Path) -> Image:
        if path in self._kept:
            self._kept.move_to_end(path)
            return self._kept[path]
        picture = read_picture(path)
        self._kept[path] = picture
        self._size += picture.nbytes
        while self._size > self._most and len(self._kept) > 1:
            _, gone = self._kept.popitem(last=False)
            self._size -= gone.nbytes
        return picture


def propose_labels(
    videos: Sequence[Path], every: int, folder: Path, settings: DetectionSettings
) -> int:
    """Write frames of videos with their detections as a COCO data set; return the number of frames.

    The folder then holds pictures/<video>_<frame>.png and labels.json, for any editor of COCO
    keypoints and for `read_labels`. The write is atomic: a failure leaves nothing that prevents a
    retry. UsageError if the folder is not empty; InputError if two videos have the same name or
    different sizes.
    """
    if folder.exists() and any(folder.iterdir()):
        todo = "Choose another folder: corrected labels are never overwritten."
        raise UsageError(str(folder), "an absent or empty folder", "files", todo)
    if len({video.stem for video in videos}) < len(videos):
        expected = "files of different names"
        todo = "Rename one: the images of its frames are named after it."
        raise InputError("videos", expected, ", ".join(video.name for video in videos), todo)
    place = folder.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.parent) as workshop:
        # One level down: a temporary folder is private, the labels have the usual rights.
        draft = Path(workshop) / place.name
        count = _write_detections(_frames(videos, every), draft, settings)
        draft.rename(place)  # replaces an empty folder, fails on any other
    return count


def _frames(videos: Sequence[Path], every: int) -> Iterator[tuple[str, Image]]:
    """Yield every n-th frame of each video, with a name; refuse another size than the first's."""
    shape: tuple[int, ...] | None = None
    for video in videos:
        with open_video(video) as reader:
            for number in range(0, len(reader), every):
                picture = reader.frame(number)
                if shape is not None and picture.shape != shape:
                    raise InputError(
                        str(video),
                        expected=f"frames of {shape[1]} x {shape[0]}, as in the previous videos",
                        found=f"{picture.shape[1]} x {picture.shape[0]}",
                        todo="Label videos of another size in a separate folder.",
                    )
                shape = picture.shape
                yield f"{video.stem}_{number:06d}", picture


def _write_detections(
    frames: Iterable[tuple[str, Image]], folder: Path, settings: DetectionSettings
) -> int:
    detectors = [as_frame_detector(each, settings) for each in load_detectors(settings)]
    pose = load_pose(settings)
    (folder / "pictures").mkdir(parents=True)
    proposed, size = [], (0, 0)
    for name, picture in frames:
        people = fuse([each.detect([picture])[0] for each in detectors], settings.nms_iou)
        sure = people.scores >= settings.high_score_threshold
        kept = people.select(sure)
        poses = combine_boxes(kept, pose.estimate(picture, kept.boxes))
        found = poses.confidence >= settings.min_keypoint_confidence
        path = folder / "pictures" / f"{name}.png"
        cv2.imwrite(str(path), picture[..., ::-1])
        # Keypoints from this confidence on are proposed as visible, others as occluded [1].
        visible = np.where(poses.confidence >= 0.5, 2, 1) * found
        proposed.append(
            LabelledPicture(
                path=path,
                boxes=np.asarray(poses.boxes, dtype=np.float64),
                keypoints=np.where(found[..., None], poses.keypoints, np.nan),
                visible=visible.astype(np.int8),
                ignored=np.zeros(len(poses.boxes), dtype=np.bool_),
            )
        )
        size = (picture.shape[1], picture.shape[0])
    write_labels(folder / "labels.json", proposed, size)
    return len(proposed)
