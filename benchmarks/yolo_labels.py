"""Boxes of people in images, from YOLO's text files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.arrays import Flags, Floats
from worldpose.errors import InputError
from worldpose.training.labels import LabelledPicture, read_picture


def read_yolo_labels(picture: Path, person: int = 0) -> LabelledPicture:
    """Return the people of an image with labels in a YOLO text file of the same name.

    A line is `class x_center y_center width height`, or `class x y x y ...` for a polygon, all
    relative to the image's sides. Objects of other classes are left out.

    Raises:
        InputError: the image or its labels cannot be read.
    """
    height, width = read_picture(picture).shape[:2]
    file, boxes = picture.with_suffix(".txt"), []
    try:
        lines = [line.split() for line in file.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise _no_yolo_labels(file, f"{type(error).__name__}: {error}") from error
    for number, (kind, *values) in enumerate((line for line in lines if line), start=1):
        try:
            numbers, is_person = np.array(values, dtype=np.float64), int(kind) == person
        except ValueError as error:
            raise _no_yolo_labels(file, f"line {number}: {error}") from error
        if len(numbers) != 4 and (len(numbers) < 6 or len(numbers) % 2):
            raise _no_yolo_labels(file, f"line {number}: {len(numbers)} numbers after the class")
        if is_person and len(numbers) == 4:
            boxes.append([*(numbers[:2] - 0.5 * numbers[2:]), *(numbers[:2] + 0.5 * numbers[2:])])
        elif is_person:
            corners = numbers.reshape(-1, 2)
            boxes.append([*corners.min(axis=0), *corners.max(axis=0)])
    # Labels count from the corner of the first pixel, boxes from its centre.
    scaled = np.array(boxes).reshape(-1, 4) * [width, height, width, height] - 0.5
    return label_boxes(picture, scaled, np.zeros(len(boxes), dtype=np.bool_))


def _no_yolo_labels(file: Path, found: str) -> InputError:
    return InputError(
        str(file),
        expected="YOLO labels: a class, then 4 numbers of a box or 6 and more of a polygon",
        found=found,
        todo="Export the labels again in YOLO's text form, one file next to each image.",
    )


def label_boxes(picture: Path, boxes: Floats, ignored: Flags) -> LabelledPicture:
    """Return labels without keypoints.

    Boxes (people, 4) are x0, y0, x1, y1 [px].
    """
    people = len(boxes)
    return LabelledPicture(
        path=picture,
        boxes=boxes,
        keypoints=np.full((people, 17, 2), np.nan),
        visible=np.zeros((people, 17), dtype=np.int8),
        ignored=ignored,
    )
