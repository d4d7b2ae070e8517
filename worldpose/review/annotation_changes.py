"""An annotator's changes, as corrections of a camera's detections (D4, D6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.review import AddedDetection, DeletedDetection, MovedKeypoint
from data_contracts.static_calibration import Pixel
from worldpose.errors import InputError
from worldpose.formats.annotations.annotated_images import AnnotatedImage, AnnotatedPerson
from worldpose.review.detections import SAME, DetectionEdit


@dataclass(frozen=True)
class Changes:
    """Changes of an annotator.

    Attributes:
        edits: in the order of application.
        pictures: number of images in the annotator's file.
        boxes: number of changed boxes of existing people: corrections cannot express these.
    """

    edits: tuple[DetectionEdit, ...]
    pictures: int
    boxes: int


def image_name(camera: str, frame: int) -> str:
    """Return the name of a camera's image of a match frame."""
    return f"{camera}_{frame:06d}.png"


def find_changes(
    exported: Sequence[AnnotatedImage], edited: Sequence[AnnotatedImage], where: str
) -> Changes:
    """Return the changes between an export and an annotator's file.

    An image that the annotator's file lacks counts as unchanged. Positions closer than a hundredth
    of a pixel count as equal, since annotation tools round.

    Args:
        exported: named by `image_name`, people with their `detection`.
        edited: from the annotator; names can have a folder, or a prefix that ends in `-`, before
            them.
        where: the annotator's file, for messages.

    Raises:
        InputError: an image that was not exported or has another size, a duplicate person, or an
            unknown detection index.
    """
    known = {PurePosixPath(picture.name).name: picture for picture in exported}
    edits: list[DetectionEdit] = []
    seen: set[str] = set()
    boxes = 0
    for picture in edited:
        name = _exported_name(picture.name, known)
        if name is None or name in seen or known[name].size != picture.size:
            raise _refusal(
                where,
                "each exported picture once, in its size",
                f"{picture.name}, {picture.size[0]} x {picture.size[1]}",
            )
        seen.add(name)
        camera, _, number = name.rpartition(".")[0].rpartition("_")
        before = {person.detection: person for person in known[name].people}
        numbers = [person.detection for person in picture.people if person.detection is not None]
        strange = [each for each in numbers if each not in before or numbers.count(each) > 1]
        if strange:
            raise _refusal(
                where,
                "people of the picture once each; an added one without a number",
                f"detection {strange[0]} in {picture.name}",
            )
        there = {person.detection: person for person in picture.people}
        free = max((each for each in before if each is not None), default=-1) + 1
        for detection, person in before.items():
            assert detection is not None  # an export numbers all people
            at = {"camera": camera, "frame": int(number), "detection": detection}
            if detection not in there:
                edits.append(DeletedDetection.model_validate(at))
                continue
            now = there[detection]
            edits += _moved(at, person.keypoints, now.keypoints)
            boxes += bool(np.abs(now.box - person.box).max() > SAME)
        for person in picture.people:
            if person.detection is None:
                edits.append(_added(camera, int(number), free, person))
                free += 1
    return Changes(tuple(edits), len(edited), boxes)


def _exported_name(given: str, known: dict[str, AnnotatedImage]) -> str | None:
    """Return the exported image's name for an annotator's name."""
    name = PurePosixPath(given.replace("\\", "/")).name
    return next((each for each in known if name == each or name.endswith(f"-{each}")), None)


def _moved(at: dict[str, object], before: Floats, now: Floats) -> list[MovedKeypoint]:
    edits = []
    for joint, was, xy in zip(COCO17, before, now, strict=True):
        old, new = _pixel(was), _pixel(xy)
        if old == new or (old and new and np.abs(was - xy).max() <= SAME):
            continue
        edits.append(MovedKeypoint.model_validate({**at, "joint": joint, "was": old, "xy": new}))
    return edits


def _added(camera: str, frame: int, detection: int, person: AnnotatedPerson) -> AddedDetection:
    x0, y0, x1, y1 = person.box.tolist()
    return AddedDetection(
        camera=camera,
        frame=frame,
        detection=detection,
        box=(x0, y0, x1, y1),
        keypoints=tuple(map(_pixel, person.keypoints)),
    )


def _pixel(xy: Floats) -> Pixel | None:
    return None if np.isnan(xy).any() else (float(xy[0]), float(xy[1]))


def _refusal(where: str, expected: str, found: str) -> InputError:
    return InputError(
        where,
        expected=expected,
        found=found,
        todo="Import what came of this very export; add people without copying others.",
    )
