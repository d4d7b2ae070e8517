"""Detections of other programs: 2D poses in OpenPose's JSON, and boxes in MOTChallenge's text.

OpenPose and Pose2Sim write one file per frame, trackers such as ByteTrack one line per box.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError, describe_value
from worldpose.formats.files import read_json
from worldpose.formats.keypoint_sets import (
    COORDINATE_LIMIT,
    KNOWN_SETS,
    MAX_CONFIDENCE,
    PEOPLE_LIMIT,
    SIZES,
    PeopleFile,
    clean_points,
    describe_fault,
    order_by_points,
    people_by_frame,
)
from worldpose.formats.pose_forms import plain_person
from worldpose.parsing import read_cells
from worldpose.video.names import frame_numbers


def read_openpose_folder(folder: Path, model: str | None = None) -> PeopleFile:
    """Return the people of one camera's folder with a JSON file of OpenPose for each frame.

    `frame_numbers` finds the frame in a file's name, `worldpose.formats.keypoint_sets` the points,
    of which `model` is Pose2Sim's name, if it is known. An empty file is a frame without people.
    """
    files = frame_files(folder)
    whole = {frame: _read_frame(files[frame]) for frame in sorted(files)}
    read = {n: people and [each for each in people if len(each)] for n, people in whole.items()}
    blank = sum(not len(each) for people in whole.values() for each in people or ())  # hands
    sizes = {len(one): files[frame] for frame, people in read.items() for one in people or ()}
    if len(sizes) > 1:
        (one, file), (two, other) = list(sizes.items())[:2]
        said = f"{one} in {file.name}, {two} in {other.name}"
        todo = "Use the files of one estimator, and remove older ones."
        raise InputError(str(folder), "the same keypoints in all frames", said, todo)
    empty = sum(people is None for people in read.values())
    found = [one for people in read.values() for one in people or ()]
    frames = np.repeat(list(read), [len(people or ()) for people in read.values()])
    points = np.array(found, np.float32) if found else np.empty((0, 17, 3), np.float32)
    order = order_by_points(str(folder), points, model)
    points, changed = clean_points(order.select(points))
    people, nobody = people_by_frame(folder, frames.astype(np.int64), points)
    people = people.reindex(np.array(list(read), np.int64))
    kind = order.name if found else None
    return PeopleFile(people, kind, changed._replace(nobody=nobody + blank, empty=empty))


def json_files(folder: Path) -> list[Path]:
    """Return the JSON files of a folder, without hidden ones such as macOS leaves (`._NAME`)."""
    return sorted(folder.glob("[!.]*.[jJ][sS][oO][nN]"))


def frame_files(folder: Path) -> dict[int, Path]:
    """Return the JSON file of each frame of a camera; errors as of `read_openpose_folder`."""
    there = {file.name: file for file in json_files(folder)}
    numbers = frame_numbers(there)
    files: dict[int, Path] = {}
    for name, file in there.items():
        if numbers.get(name, FRAME_LIMIT + 1) > FRAME_LIMIT:
            todo = "Name it as cam01_000012.json, or move it elsewhere."
            expected = f"a frame number up to {FRAME_LIMIT} in the name"
            raise InputError(str(file), *describe_fault(name, numbers, expected), todo)
        if numbers[name] in files:
            found = f"{files[numbers[name]].name} with the same frame number"
            todo = "Keep the poses of one camera and one estimator in a folder."
            raise InputError(str(file), "one file per frame", found, todo)
        files[numbers[name]] = file
    if not files:
        todo = "Run pose estimation for this camera first."
        raise InputError(str(folder), "a .json file for each frame", "none", todo)
    return files


def _read_frame(file: Path) -> list[NDArray[np.float64]] | None:
    """Return the keypoints (n, 3) x, y, confidence of each person of a frame; None if empty."""
    if not file.stat().st_size:
        return None
    content = read_json(file)
    known = ("people", "bodies", "instance_info", "results", "annots")  # the last of EasyMocap
    keys = [key for key in known if isinstance(content, dict) and key in content]
    people = content[keys[0]] if keys else content
    if content == []:
        return None
    if not isinstance(people, list) or len(people) > PEOPLE_LIMIT:
        expected = f"a list of at most {PEOPLE_LIMIT} people, as OpenPose writes it"
        found = f"{len(people)} people" if isinstance(people, list) else type(people).__name__
        todo = "Write the poses in OpenPose's form (Pose2Sim: output_format = 'openpose')."
        raise InputError(f"{file}: people", expected, found, todo)
    return [_read_person(f"{file}: people[{n}]", person) for n, person in enumerate(people)]


def _read_person(where: str, person: Any) -> NDArray[np.float64]:  # noqa: ANN401
    entries = (person if isinstance(person, dict) else {}) | (plain_person(person) or {})
    # Of OpenPose's version 1 and later, of its versions 0, and of other programs.
    keypoints_keys = ("pose_keypoints_2d", "pose_keypoints", "joints", "keypoints")
    named = [key for key in keypoints_keys if key in entries]
    key = next(
        (key for key in named if entries[key] not in (None, [])), (*named, *keypoints_keys)[0]
    )
    numbers = entries.get(key)
    if key in entries and numbers in (None, []):
        return np.empty((0, 3))
    if not isinstance(numbers, list) or len(numbers) not in {3 * size for size in SIZES}:
        found = f"{len(numbers)} entries" if isinstance(numbers, list) else f"{numbers!r:.40}"
        todo = "Estimate poses with one of these sets (Pose2Sim: pose_model = 'Body_with_feet')."
        raise InputError(
            f"{where}.{key}", f"x, y, confidence of each point, of {KNOWN_SETS} points", found, todo
        )
    for place, one in enumerate(numbers):  # null, which JSON has for NaN, is a missing point
        is_huge = type(one) is int and one.bit_length() > 1023
        if is_huge or type(one) not in (int, float, NoneType):
            todo = "Write numbers, and 0, 0, 0 or null where a point is missing."
            raise InputError(f"{where}.{key}[{place}]", "a number", describe_value(one), todo)
    values = np.array(numbers, dtype=np.float64).reshape(-1, 3)
    off = (np.abs(values) > COORDINATE_LIMIT).any(axis=1) | (np.abs(values[:, 2]) > MAX_CONFIDENCE)
    if off.any():
        expected = f"pixels up to {COORDINATE_LIMIT:g}, and confidences from 0 to 1"
        todo = "Estimate the poses of this frame again."
        raise InputError(
            f"{where}.{key}", expected, ", ".join(f"{number:g}" for number in values[off][0]), todo
        )
    return values


class GivenBoxes(NamedTuple):
    """Boxes of people in one video, as a tracker gave them, sorted by frame."""

    frame: NDArray[np.int64]
    """(boxes,) frame of the video, from 0."""
    person: NDArray[np.int64]
    """(boxes,) the tracker's id; -1 without one."""
    box: NDArray[np.float64]
    """(boxes, 4) x0, y0, x1, y1 [px]; (0, 0) is the centre of the top-left pixel."""
    score: NDArray[np.float64]
    """(boxes,) in (0, 1]."""
    changes: tuple[str, ...] = ()
    """What was changed or left out, with its number."""


def read_boxes(file: Path, size: tuple[int, int], frames: int) -> GivenBoxes:
    """Return the boxes of a MOTChallenge text, or of an npy file (frames, persons, 4).

    A line is frame, id, left, top, width, height, and up to four more numbers: confidence (-1 is
    taken as 1, and a box of confidence 0 is not counted, as in MOTChallenge's truth) and the class,
    of which 1 is a person and -1 is not known; of 8 or 10 numbers, 0 is one if no box has these. Of
    10 numbers it may be VisDrone's, which has persons of class 1 and 2, or a place in the world.
    Frames begin at 1, and (1, 1) is the upper left corner of the image. Trackers follow people out
    of the image, whose width and height are `size` [px]: such boxes are left out. InputError for a
    frame beyond `frames`, an id twice in a frame, or most boxes outside of the image.
    """
    if file.suffix.lower() == ".npy":
        return _read_identified(file, frames)
    lines, rows = _read_rows(file)
    frame, person, box = rows[:, 0], rows[:, 1], rows[:, 2:6]
    corner = box[:, :2] - 1.5
    boxes = np.concatenate([corner, corner + box[:, 2:]], axis=1)
    score = rows[:, 6] if rows.shape[1] > 6 else np.full(len(rows), -1.0)
    is_person = np.ones(len(rows), np.bool_)
    # Of ten numbers the last three are a place [m], or VisDrone's class, truncation and occlusion.
    said, count, usual = rows[:, 7:], rows.shape[1], 1
    largest = (999,) if count == 8 else (11, 2, 2)[: said.shape[1]]
    is_class = (said == np.round(said)) & (said >= -1) & (said <= largest)
    if count == 9 or (said.any() and is_class.all()):
        # Class of people in MOTChallenge's truth, none, and in VisDrone's; else COCO's from 0.
        is_person = np.isin(said[:, 0], (1, -1, 2) if count == 10 else (1, -1))
        if count != 9 and not is_person.any():
            is_person, usual = said[:, 0] == 0, 0
    kept = (score != 0.0) & is_person
    pairs = np.stack([frame, person], axis=1)
    order = np.lexsort((np.arange(len(rows)), person, frame))
    again = np.zeros(len(rows), np.bool_)
    again[order[1:]] = (pairs[order[1:]] == pairs[order[:-1]]).all(axis=1)
    # Right and bottom are larger than left and top in every box, end in the image, and end beyond
    # it as sides of boxes.
    cut = ((boxes[:, 2:] - size > 0.1 * box[:, 2:]).any(axis=1)) & is_person
    is_corner = (box[is_person, 2:] > box[is_person, :2]).all()
    # So does the right side follow the left one, as no width does, where people move about: read
    # as widths, these are wide for a person's height, or change much more than it [1].
    left, right = box[is_person][:, [0, 2]].T
    enough = 10  # boxes
    with np.errstate(invalid="ignore", divide="ignore"):
        shape = np.log(right / box[is_person, 3])
        follows = len(left) >= enough and np.std(right - left) < 0.3 * np.std(right)
        follows = follows and (np.mean(shape) > np.log(2 / 3) or np.std(shape) > 0.3)
    is_corner &= follows or cut.sum() > 0.2 * len(cut)
    within = (box[:, 2:] <= np.array(size) + 1.0).all(axis=1) & is_person
    is_corner &= within.sum() > 0.9 * is_person.sum()
    outside = ((boxes[:, :2] >= np.array(size) - 0.5) | (boxes[:, 2:] <= -0.5)).any(axis=1)
    most = f"a frame from 1 to {frames}, as many as the video has"
    for wrong, key, expected in (
        (~np.isfinite(rows).all(axis=1), "", "finite numbers"),
        ((frame != np.round(frame)) | (frame < 1), "frame", most + "; add 1 if they begin at 0"),
        (frame > frames, "frame", most),
        ((person != np.round(person)) | (np.abs(person) > FRAME_LIMIT), "id", "a whole number"),
        (again & kept & (person >= 0), "id", "each id once in a frame"),
        ((box[:, 2:] <= 0.0).any(axis=1), "width, height", "more than 0 px"),
        (
            (box[:, 3] <= 1.0) & ((box[:, 3] <= 1.0).mean() > 0.5),
            "height",
            "more than 1 px, as most should be; is the id missing, and this the confidence?",
        ),
        (
            outside & (outside.mean() > 0.5),
            "left, top, width, height",
            f"a box in the image of {size[0]} x {size[1]} px, as most should be",
        ),
        (
            is_person & is_corner & (cut | follows),
            "left, top, width, height",
            f"width and height of a box in the image of {size[0]} x {size[1]} px, as most should "
            "be; are these right and bottom?",
        ),
        (
            (score > MAX_CONFIDENCE) | ((score < 0.0) & (score != -1.0)),
            "confidence",
            "0 to 1, or -1",
        ),
    ):
        if wrong.any():
            row = int(np.argmax(wrong))
            number, text = lines[row]
            todo = "Correct the file, or write it again."
            raise InputError(
                f"{file}: line {number}{': ' if key else ''}{key}", expected, f"{text!r:.80}", todo
            )
    if not kept.any():
        expected = "a box of a person (class 1 or -1) with a confidence above 0"
        found = f"{len(rows)} boxes, {int((~is_person).sum())} of them of another class"
        todo = "Write the class of people as 1 or -1, and confidences above 0."
        raise InputError(str(file), expected, found, todo)
    changes = {
        f"of another class than {usual}, a person, which are left out": int((~is_person).sum()),
        "of confidence 0, which are left out": int((is_person & (score == 0.0)).sum()),
        "outside of the image, which are left out": int((kept & outside).sum()),
        "of a confidence above 1, which counts as 1": int((kept & (score > 1.0)).sum()),
    }
    kept &= ~outside
    chosen = order[kept[order]]
    return GivenBoxes(
        frame[chosen].astype(np.int64) - 1,
        np.maximum(person[chosen].astype(np.int64), -1),
        boxes[chosen],
        np.where(score[chosen] == -1.0, 1.0, np.minimum(score[chosen], 1.0)),
        tuple(f"{count} boxes {what}" for what, count in changes.items() if count),
    )


def _read_identified(file: Path, frames: int) -> GivenBoxes:
    """Return the boxes of an npy file, whose rows are the people."""
    from worldpose.formats.challenge import read_kit_array  # late: it loads the body

    boxes = read_kit_array(file, "boxes")
    if len(boxes) != frames:
        expected = f"{frames} frames, as many as the video has"
        raise InputError(str(file), expected, f"{len(boxes)}", "Give the boxes of this video.")
    frame, person = np.nonzero(np.isfinite(boxes).all(-1))
    return GivenBoxes(frame, person, boxes[frame, person], np.ones(len(frame)))


def _read_rows(file: Path) -> tuple[list[tuple[int, str]], NDArray[np.float64]]:
    """Return the number and text of each line that is not empty, and its numbers."""
    box_bytes = 1 << 28  # that of 22 people in an hour has 200 MB

    def wrong(where: str, expected: str, found: str) -> InputError:
        todo = "Write lines of MOTChallenge: frame,id,left,top,width,height,confidence."
        return InputError(where, expected, found, todo)

    cells, has_commas = read_cells(file, box_bytes, "Write lines of MOTChallenge.")
    if not cells:
        raise wrong(str(file), "boxes", "an empty file")
    sign = "." if has_commas else ","
    lines = [(n, ",".join(cell.replace(",", sign) for cell in row)) for n, row in cells]
    count = lines[0][1].count(",") + 1
    box_columns = range(6, 11)  # 10 of a result, 9 of MOTChallenge's truth
    for number, each in lines:
        if each.count(",") + 1 != count or count not in box_columns:
            raise wrong(
                f"{file}: line {number}",
                f"{count if count in box_columns else '6 to 10'} numbers, separated by commas",
                f"{each!r:.80}",
            )
    try:
        rows = np.loadtxt([each for _, each in lines], delimiter=",", ndmin=2, comments=None)
    except ValueError as error:
        row = re.search(r"at row (\d+)", str(error))
        number, each = lines[int(row[1])] if row else lines[0]
        raise wrong(f"{file}: line {number}", "numbers", f"{each!r:.80}") from error
    return lines, rows
