"""Reader of COCO keypoint results: a JSON list of people, or a data set with `annotations`.

Per person: `image_id`; `keypoints`, x y c of each point, where c is the confidence (in a data set
perhaps COCO's visibility 0, 1, 2) and 0 means missing; `bbox` or `box` (x y width height) and
`score` are optional: the defaults are the box of the found joints and their mean confidence. Within
each frame, people keep the file's order. AlphaPose and detectors of COCO write this form;
`worldpose.formats.pose_forms` brings that of others into it.

The frame is a whole `image_id`, or the number in an `image_id` that is a file's name
(`frame_numbers`). In a data set it is that in the `file_name` of the image, or the image's
`frame_id`. `worldpose.formats.keypoint_sets` says how the points are told.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, takewhile
from pathlib import Path
from types import NoneType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError, describe_value
from worldpose.formats.archives import PACKED_BYTES, PACKED_RATIO
from worldpose.formats.files import JsonItems
from worldpose.formats.keypoint_sets import (
    COORDINATE_LIMIT,
    MAX_CONFIDENCE,
    PeopleFile,
    clean_points,
    describe_fault,
    order_by_names,
    order_by_points,
    people_by_frame,
    unknown_size,
)
from worldpose.formats.pose_forms import plain_entries
from worldpose.video.names import frame_numbers

BATCH = 4096
"""Results per batch of Python objects."""

_COUNT_TODO: Final = "Export all points, and 0, 0, 0 where one is missing."
_NUMBER_TODO: Final = (
    "Number the images from 0 in the order of the video, in image_id or file_name."
)


def read_coco_results(path: Path) -> PeopleFile:
    """Return the people of a results file by rising frame, without frames that have no people.

    The function reads in batches: the arrays bound the memory, not Python objects. InputError also
    for an unknown set of points, a confidence of another scale, and too many people per frame.
    """
    json_bytes = 1 << 30  # two million people; npz holds more and is faster
    keep = ("images", "meta_info")
    items = JsonItems(path, "annotations", json_bytes, keep, other_key="instance_info")
    categories = _categories(path, json_bytes)
    entries = plain_entries(str(path), items)
    batches, foreign = [], 0
    posed, pointless_of = set[str](), list[str]()  # categories with points, and of entries without
    for first, results in _batches(path, entries):
        for each in results:
            given = each.get("keypoints")
            is_empty = not given or (isinstance(given, list) and not any(given))
            if items.is_mapping or is_empty:
                is_other = categories.are_other(given, each.get("category_id"))
                if is_other or (is_empty and each.get("iscrowd") == 1):  # one box of many people
                    each.update(keypoints=None, bbox=None, box=None)
                    foreign += is_other
        batches.append(batch := _read_batch(path, results, first, is_set=items.is_mapping))
        for each, lacks in zip(results, batch.lacks.tolist(), strict=True):
            category = sys.intern(str(each.get("category_id")))
            (pointless_of.append if lacks else posed.add)(category)
    if not items.has_list:
        expected = "a list of COCO keypoint results, a COCO data set with `annotations`, or the "
        expected += "results of MMPose or Ultralytics"
        there = describe_value(items.other or ", ".join(items.seen))
        raise InputError(str(path), expected, there, "Export the poses as COCO keypoint results.")
    if batches and not posed:
        count = len(pointless_of)
        what = "annotations" if items.is_mapping else "entries"
        there, todo = f"{count} {what} without keypoints", "Export poses, not boxes alone."
        if foreign:
            share = "all" if foreign == count else foreign
            there = f"{count} annotations, {share} of categories other than {categories.called}"
            todo = "Give people the category that names their keypoints."
        raise InputError(f"{path}: annotations", "keypoints of people", there, todo)
    found = _join(path, batches)
    points = found.points
    posed.discard("None")
    # A box alone is a person's if others of its category have points; a ball has another one.
    alone = np.flatnonzero(found.lacks)
    other = np.array([each not in posed for each in pointless_of], bool)
    found.boxes[alone[other | ~np.all(found.boxes[alone, 2:] > 0.0, axis=1)]] = np.nan
    pointless = int(np.isnan(found.boxes[alone]).any(axis=1).sum())
    if items.is_mapping and np.isin(np.nan_to_num(points[..., 2]), (0, 1, 2)).all():
        points[..., 2] = np.minimum(points[..., 2], 1)  # visibility: 1 occluded, 2 visible
    sure = points[..., 2]
    wrong_scale = np.abs(sure) > MAX_CONFIDENCE  # NaN is a missing point, as below 0
    confidence_todo = "Scale the detector's scores so that 1 is certain and 0 is missing."
    _require_right(path, points, ~wrong_scale, 0, "a confidence from 0 to 1", confidence_todo)
    where = f"{path}: categories"
    names = categories.names or _model_names(items.kept.get("meta_info"))
    if names and len(names) != points.shape[1] and len(points):
        raise _wrong(where, f"names of {points.shape[1]} keypoints", f"{len(names)} names")
    order = order_by_names(where, names) if names else order_by_points(str(path), points)
    points, changed = clean_points(order.select(points))
    frames = _frames(path, found.images, items.kept.get("images"))
    # A full frame pads all others, in a small file too.
    limit = max(PACKED_BYTES, PACKED_RATIO * path.stat().st_size)
    people, nobody = people_by_frame(path, frames, points, found.boxes, found.scores, limit)
    nobody, pointless = nobody - pointless, pointless - foreign
    changed = changed._replace(nobody=nobody, pointless=pointless, foreign=foreign)
    return PeopleFile(people, order.name, changed)


class _Results(NamedTuple):
    """Some results: their images' ids, points (n, points, 3), boxes (n, 4) and scores (n,).

    `lacks` (n,) tells which ones have no points.
    """

    images: list[int | str]
    points: NDArray[np.float32]
    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]
    lacks: NDArray[np.bool_]


def _join(path: Path, batches: Sequence[_Results]) -> _Results:
    """Return all results, which must have the same points; a batch without any takes theirs."""
    sizes = sorted({batch.points.shape[1] for batch in batches if not batch.lacks.all()})
    if len(sizes) > 1:
        raise _wrong(str(path), "the same points of all people", f"{sizes[0]} and {sizes[1]}")
    size = sizes[0] if sizes else len(COCO17)
    none = np.empty((0, 0, 3), np.float32), np.empty((0, 4)), np.empty(0), np.empty(0, np.bool_)
    images, points, *others = zip(_Results([], *none), *batches, strict=True)
    rows = [
        np.zeros((len(each), size, 3), np.float32) if lacks.all() else each
        for each, lacks in zip(points, others[-1], strict=True)
    ]
    arrays = map(np.concatenate, [rows, *others])
    return _Results(list(chain.from_iterable(images)), *arrays)


def _batches(path: Path, items: Iterable[Any]) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Yield batches of results, each with the index of its first result in the file."""
    batch: list[dict[str, Any]] = []
    for index, result in enumerate(items):
        if type(result) is not dict:
            expected = "a mapping with image_id and keypoints"
            raise _result_error(path, index, "", expected, describe_value(result))
        batch.append(result)
        if len(batch) == BATCH:
            yield index + 1 - BATCH, batch
            batch = []
    if batch:
        yield index + 1 - len(batch), batch


def _read_batch(path: Path, results: list[dict[str, Any]], first: int, *, is_set: bool) -> _Results:
    """Return results; null, no or an empty list in place of points is none, with a set or a box."""
    max_points = 1000  # maximum points of a person
    images = _images(path, results, first)
    lacks = np.array(
        [
            each.get("keypoints", None if is_set or each.get("bbox") or each.get("box") else 0)
            in (None, [])
            for each in results
        ]
    )
    posed = np.flatnonzero(~lacks).tolist()
    given = results[posed[0]].get("keypoints") if posed else []
    width = len(given) if type(given) is list and len(given) % 3 == 0 else 51
    if width > 3 * max_points:
        raise unknown_size(f"{path}: result {first + posed[0]}, keypoints", width // 3)
    points = np.zeros((len(results), width // 3, 3))
    if posed:
        table = _table(path, results, posed, "keypoints", width, first)
        points[posed] = table.reshape(len(posed), width // 3, 3)
    near = ~np.any(np.abs(points) > COORDINATE_LIMIT, axis=-1)
    certain = f"pixels up to {COORDINATE_LIMIT:g} (a missing point is 0, 0, 0)"
    _require_right(path, points, near, first, certain, _COUNT_TODO)
    for result in results:
        if result.get("bbox") is None:
            result["bbox"] = result.get("box")
    boxes = _optional(path, results, "bbox", 4, first)
    scores = _optional(path, results, "score", 1, first)[:, 0]
    return _Results(images, points.astype(np.float32), boxes, scores, lacks)


def _images(path: Path, results: list[dict[str, Any]], first: int) -> list[int | str]:
    """Return the id of each result's image: a number, or a file's name."""
    images = [result.get("image_id") for result in results]
    for index, image in enumerate(images, first):
        if not (type(image) is int and image >= 0) and not (type(image) is str and image):
            what = "the frame, a whole number from 0, or the name of an image"
            raise _result_error(path, index, "image_id", what, describe_value(image), _NUMBER_TODO)
    return images  # type: ignore[return-value] # checked


def _frames(path: Path, images: Sequence[int | str], listed: object) -> NDArray[np.int64]:
    """Return the frame of each result from its image's id, or from the images of the data set."""
    is_set = isinstance(listed, list) and bool(listed)
    frame_of: dict[Any, int] = {}
    if isinstance(listed, list) and listed:
        frame_of |= _listed_frames(path, listed)
    else:
        frame_of |= frame_numbers(image for image in images if isinstance(image, str))
        _require_distinct(path, "image_id", frame_of)
    frames = np.empty(len(images), np.int64)
    for index, image in enumerate(images):
        frame = frame_of.get(image, None if is_set or isinstance(image, str) else image)
        if frame is None or frame > FRAME_LIMIT:
            what, found = "an id of `images`", describe_value(image)
            if frame is not None:
                what = f"a frame from 0 to {FRAME_LIMIT}, in file_name where there are `images`"
                found = describe_value(image if frame == image else f"{image}, frame {frame}")
            elif not is_set:
                what, found = describe_fault(image, frame_of, "a number in the name of the image")
            raise _result_error(path, index, "image_id", what, found, _NUMBER_TODO)
        frames[index] = frame
    return frames


def _listed_frames(path: Path, listed: Sequence[Any]) -> dict[int | str, int]:
    """Return the frame of each image of a data set: that of its file's name, or its `frame_id`."""
    names = [image.get("file_name") if isinstance(image, dict) else None for image in listed]
    number_of = frame_numbers(name for name in names if isinstance(name, str))
    frames: dict[int | str, int] = {}
    for index, (image, name) in enumerate(zip(listed, names, strict=True)):
        number = number_of.get(str(name))
        if number is None and isinstance(image, dict) and type(image.get("frame_id")) is int:
            number = image["frame_id"]
        if number is None or type(image.get("id")) not in (int, str):
            expected = "an id, and the frame's number in file_name or frame_id"
            fault = describe_fault(name, number_of, expected)
            raise _wrong(f"{path}: images[{index}]", *fault)
        frames[image["id"]] = number
    _require_distinct(path, "images", frames, len(listed))
    return frames


def _require_distinct(
    path: Path, key: str, frames: Mapping[Any, int], count: int | None = None
) -> None:
    """Raise InputError if several pictures have one frame: they are of several cameras."""
    count = len(frames) if count is None else count
    if len(set(frames.values())) < count:
        found = f"{count} images with {len(set(frames.values()))} numbers"
        raise _wrong(f"{path}: {key}", "names of one camera's images whose numbers differ", found)


class _Categories(NamedTuple):
    """Categories of a data set: the names of people's points, of these categories, other ids."""

    names: Sequence[str] = ()
    called: str = ""
    others: Sequence[Any] = ()
    nameless: Sequence[Any] = ()

    def are_other(self, points: object, category: object) -> bool:
        """Return whether points are of a category that names others, or none and has others."""
        has_others = isinstance(points, list) and len(points) not in (0, 3 * len(self.names))
        return bool(points) and (
            category in self.others or (category in self.nameless and has_others)
        )


def _categories(path: Path, limit: int) -> _Categories:
    """Return the categories of a data set, after its annotations; empty without points' names."""
    items = JsonItems(path, "categories", limit)
    given = [each for each in takewhile(lambda _: items.is_mapping, items) if type(each) is dict]
    lists = [each.get("keypoints") for each in given]
    names = [tuple(map(str, each)) if isinstance(each, list) else () for each in lists]
    of: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    balls: list[dict[str, Any]] = []
    for own, each in zip(names, given, strict=True):
        # Names of people, such as ball_carrier, have more words.
        ball = r"((sports?|soccer|foot|basket|hand|volley)[ _-]?)?balls?"
        is_ball = re.fullmatch(ball, str(each.get("name")).strip().lower())
        (balls if is_ball else of.setdefault(own, [])).append(each)
    ids = [each.get("id", ()) for each in balls]
    nameless = of.pop((), [])
    if not of:
        return _Categories(called="people", others=ids)
    chosen = [key for key in of if any(each.get("name") == "person" for each in of[key])]
    chosen = list(of) if len(of) == 1 else chosen
    if len(chosen) != 1:
        count = sum(map(len, of.values()))
        raise _wrong(f"{path}: categories", "the keypoints of one category", f"{count}")
    people = of.pop(chosen[0])
    called = ", ".join(str(each.get("name", each.get("id"))) for each in people)
    others = [*ids, *(each.get("id", ()) for each in chain.from_iterable(of.values()))]
    return _Categories(chosen[0], called, others, [each.get("id", ()) for each in nameless])


def _model_names(about: object) -> list[str]:
    """Return the names of the points in MMPose's `meta_info`; none where it has none."""
    named = about.get("keypoint_id2name") if isinstance(about, dict) else None
    if not isinstance(named, dict) or sorted(named) != sorted(map(str, range(len(named)))):
        return []
    return [str(named[str(index)]) for index in range(len(named))]


def _table(
    path: Path,
    results: list[dict[str, Any]],
    indices: Sequence[int],
    key: str,
    width: int,
    first: int,
) -> NDArray[np.float64]:
    """Return entry `key` of some results as (results, width), including NaN and infinity."""
    rows = [results[index].get(key) for index in indices]
    if width == 1:
        rows = [[row] for row in rows]
    well_formed = set(map(type, rows)) <= {list} and set(map(len, rows)) <= {width}  # type: ignore[arg-type]
    # Check types, since numpy would accept "1" and True as numbers. Null is JSON's NaN.
    if well_formed and set(map(type, chain.from_iterable(rows))) <= {int, float, NoneType}:  # type: ignore[arg-type]
        try:
            return np.array(rows, dtype=np.float64).reshape(-1, width)
        except OverflowError:  # an integer beyond float64
            pass
    raise _find_error(path, rows, [first + index for index in indices], key, width)


def _find_error(
    path: Path, rows: list[Any], indices: Sequence[int], key: str, width: int
) -> InputError:
    expected = "x, y, confidence of each point"
    what = f"{width} numbers: {expected}" if key == "keypoints" else f"{width} numbers"
    todo = _COUNT_TODO if key == "keypoints" else "Correct the file."
    for index, row in zip(indices, rows, strict=True):
        if type(row) is not list or len(row) != width:
            found = f"{len(row)}" if type(row) is list else describe_value(row)
            return _result_error(path, index, key, what, found, todo)
        for place, number in enumerate(row):
            fits = type(number) in (float, NoneType)
            fits |= type(number) is int and number.bit_length() < 1024
            if not fits:
                return _result_error(
                    path, index, f"{key}[{place}]", "a number", describe_value(number)
                )
    raise AssertionError("called for a table without a fault")


def _require_right(
    path: Path,
    points: NDArray[np.floating],
    right: NDArray[np.bool_],
    first: int,
    expected: str,
    todo: str,
) -> None:
    if not np.all(right):
        index, point = (int(i) for i in np.argwhere(~right)[0])
        found = ", ".join(f"{number:g}" for number in points[index, point])
        named = points.shape[1] == len(COCO17)
        place = (
            f"keypoints joint {point} ({COCO17[point]})" if named else f"keypoints, point {point}"
        )
        raise _result_error(path, first + index, place, expected, f"x, y, c = {found}", todo)


def _optional(
    path: Path, results: list[dict[str, Any]], key: str, width: int, first: int
) -> NDArray[np.float64]:
    """Return entry `key` as (results, width) [px], or scores; NaN rows if absent or null."""
    given = [index for index, result in enumerate(results) if result.get(key) is not None]
    values = np.full((len(results), width), np.nan)
    table = _table(path, results, given, key, width, first)
    # The last two of a box are its size; neither they nor a score can be negative. NaN is absent.
    fits = (np.abs(table) <= COORDINATE_LIMIT).all(axis=1) & (table[:, -2:] >= 0).all(axis=1)
    fits |= np.isnan(table).all(axis=1)
    if not np.all(fits):
        row = int(np.argmin(fits))
        what = "a finite score from 0" if key == "score" else "x, y, width and height [px]"
        raise _result_error(path, first + given[row], key, what, f"{table[row].tolist()}")
    values[given] = table
    return values


def _result_error(
    path: Path, index: int, place: str, expected: str, found: str, todo: str = "Correct the file."
) -> InputError:
    where = f"{path}: result {index}" + (f", {place}" if place else "")
    return InputError(where, expected=expected, found=found, todo=todo)


def _wrong(where: str, expected: str, found: str) -> InputError:
    todo = _NUMBER_TODO if "images" in where else "Correct the file."
    return InputError(where, expected=expected, found=found, todo=todo)
