"""Replay of corrections over the keypoints and boxes of a detector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Final, TypeAlias

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.review import AddedDetection, DeletedDetection, MovedKeypoint
from data_contracts.static_calibration import Pixel
from worldpose.errors import InputError
from worldpose.formats.annotations.annotated_images import AnnotatedImage, AnnotatedPerson

DetectionEdit: TypeAlias = AddedDetection | DeletedDetection | MovedKeypoint
DETECTION_EDITS = (AddedDetection, DeletedDetection, MovedKeypoint)
TOLERANCE_PX: Final = 0.01
"""Maximum difference of equal keypoints [px]: the store has single precision, and pages show
rounded values."""


@dataclass(frozen=True, eq=False)
class DetectionReplay:
    """Detections of one camera with corrections; per edit, why it does not apply, or None."""

    observations: KeypointDetections
    objections: tuple[str | None, ...]


def replay_detections(found: KeypointDetections, edits: Iterable[DetectionEdit]) -> DetectionReplay:
    """Return the detections of one camera with corrections applied in order.

    An edit applies only if the current value equals its `was`. Corrected keypoints and added people
    have confidence 1; other keypoints, and the indices of detections, stay. If an added person
    exceeds the number of detections, every frame gets more. `found` is not modified.
    """
    changed = found.with_arrays(
        {name: array.copy() for name, array in found.arrays().items()}, found.frame
    )
    objections = []
    for edit in edits:
        # Places of people whose corrections were withdrawn since stay, and nobody fills them.
        objection = find_objection(changed, edit, unfilled=99)
        objections.append(objection)
        if objection is not None:
            continue
        at = np.searchsorted(changed.frame, edit.frame), edit.detection
        if isinstance(edit, DeletedDetection):
            for array in changed.arrays().values():
                array[at] = np.nan
        elif isinstance(edit, AddedDetection):
            changed = _with_place(changed, edit.detection)
            keypoints = np.array([xy or (np.nan, np.nan) for xy in edit.keypoints])
            changed.keypoints[at] = keypoints
            changed.confidence[at] = np.where(np.isnan(keypoints[:, 0]), np.nan, 1.0)
            changed.boxes[at] = edit.box
            changed.score[at] = 1.0
        else:
            joint = COCO17.index(edit.joint)
            changed.keypoints[(*at, joint)] = np.nan if edit.xy is None else edit.xy
            changed.confidence[(*at, joint)] = np.nan if edit.xy is None else 1.0
    return DetectionReplay(changed, tuple(objections))


def find_objection(
    found: KeypointDetections, edit: DetectionEdit, *, unfilled: int = 0
) -> str | None:
    """Return why an edit does not apply to a camera's detections; None if it does.

    An added person can leave at most `unfilled` places free before it.
    """
    place = f"detection {edit.detection} of {edit.camera} in frame {edit.frame}"
    row = _row(found, edit.frame)
    if row is None:
        return f"{edit.camera} has no frame {edit.frame}"
    places = found.score.shape[1]
    is_there = 0 <= edit.detection < places and not np.isnan(found.score[row, edit.detection])
    if isinstance(edit, AddedDetection):
        if edit.detection > places + unfilled:
            return f"{place} would leave places free before it: {places} is the next"
        return f"there is a {place} already" if is_there else None
    if not is_there:
        return f"there is no {place}"
    if isinstance(edit, DeletedDetection):
        box = found.boxes[row, edit.detection].astype(np.float64)
        if edit.was is None or np.abs(box - edit.was).max() <= TOLERANCE_PX:
            return None
        seen = [round(float(value), 2) for value in box]
        return f"the box of {place} was {list(edit.was)} when it was deleted, and is {seen} now"
    if edit.joint not in COCO17:
        return f"COCO-17 has no joint {edit.joint}"
    now = found.keypoints[row, edit.detection, COCO17.index(edit.joint)].astype(np.float64)
    if np.isnan(now).any():
        return f"{edit.joint} of {place} is not seen" if edit.was or edit.xy is None else None
    if edit.was is None or np.abs(now - edit.was).max() > TOLERANCE_PX:
        was, seen = edit.was or "not seen", [round(float(value), 2) for value in now]
        return f"{edit.joint} of {place} was {was} when it was corrected, and is {seen} now"
    return None


def _with_place(found: KeypointDetections, detection: int) -> KeypointDetections:
    """Return observations with room for a detection index; new entries are NaN."""
    more = detection + 1 - found.score.shape[1]
    if more <= 0:
        return found
    widened = {
        name: np.pad(
            array, [(0, 0), (0, more)] + [(0, 0)] * (array.ndim - 2), constant_values=np.nan
        )
        for name, array in found.arrays().items()
    }
    return found.with_arrays(widened, found.frame)


def _row(found: KeypointDetections, frame: int) -> int | None:
    """Return the row of a match frame; None if the camera has no such frame."""
    row = int(np.searchsorted(found.frame, frame))
    return row if row < len(found.frame) and found.frame[row] == frame else None


@dataclass(frozen=True)
class Changes:
    """Changes of an annotator in a file of `pictures`: edits in the order of application.

    `boxes` is the number of changed boxes of existing people: corrections cannot express these.
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
        edited: images from the annotator; names can have a folder, or a prefix that ends in `-`,
            before them.
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
                edits.append(DeletedDetection.model_validate({**at, "was": person.box.tolist()}))
                continue
            now = there[detection]
            edits += _list_moved(at, person.keypoints, now.keypoints)
            boxes += bool(np.abs(now.box - person.box).max() > TOLERANCE_PX)
        for person in picture.people:
            if person.detection is None:
                edits.append(_describe_added(camera, int(number), free, person))
                free += 1
    return Changes(tuple(edits), len(edited), boxes)


def _exported_name(given: str, known: dict[str, AnnotatedImage]) -> str | None:
    """Return the exported image's name for an annotator's name; a camera's id can have a `-`."""
    name = "-" + PurePosixPath(given.replace("\\", "/")).name
    return max((each for each in known if name.endswith(f"-{each}")), key=len, default=None)


def _list_moved(at: dict[str, object], before: Floats, now: Floats) -> list[MovedKeypoint]:
    edits = []
    for joint, was, xy in zip(COCO17, before, now, strict=True):
        old, new = _pixel(was), _pixel(xy)
        if old == new or (old and new and np.abs(was - xy).max() <= TOLERANCE_PX):
            continue
        edits.append(MovedKeypoint.model_validate({**at, "joint": joint, "was": old, "xy": new}))
    return edits


def _describe_added(
    camera: str, frame: int, detection: int, person: AnnotatedPerson
) -> AddedDetection:
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
