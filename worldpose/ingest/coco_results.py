"""Reader of COCO keypoint results: a JSON list of people, or a data set with `annotations`.

Per person: `image_id`, the frame index; `keypoints`, x y c of the 17 COCO joints, where c is the
confidence in 0..1 (in a data set it may be COCO's visibility 0, 1, 2) and 0 means missing; `bbox`
(x y width height) and `score` are optional: the defaults are the box of the found joints and their
mean confidence. People keep the order of the file within a frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError
from worldpose.ingest.json_items import JsonItems
from worldpose.ingest.keypoint_arrays import (
    ARRAY_BYTES,
    COORDINATE_LIMIT,
    PEOPLE_LIMIT,
)
from worldpose.ingest.npz_files import PACKED_BYTES, PACKED_RATIO

JSON_BYTES: Final = 1 << 30
"""Maximum size of a JSON file [byte], about two million people; npz holds more and is faster."""

OVERSHOOT: Final = 1.1
"""Maximum confidence that counts as 1: the peak of an interpolated heat map slightly exceeds 1."""

BATCH: Final = 4096
"""Results per batch of Python objects."""

_JOINTS: Final = len(COCO17)
_COUNT_TODO: Final = "Export all 17 joints in COCO's order, and 0, 0, 0 where one is missing."
_CONFIDENCE_TODO: Final = "Scale the detector's scores so that 1 is certain and 0 is missing."


def read_coco_results(path: Path) -> KeypointDetections:
    """Return the people of a results file by rising frame, without frames that have no people.

    The function reads in batches: the arrays bound the memory, not Python objects.

    Raises:
        InputError: with file, result and joint: unreadable, another number of joints, NaN, a
            confidence outside 0..1, no frame index, or too many people in a frame.
    """
    items = JsonItems(path, "annotations", JSON_BYTES)
    batches = [_read_batch(path, results, first) for first, results in _batches(path, items)] or [
        _read_batch(path, [], 0)
    ]
    if not items.has_list:
        raise InputError(
            str(path),
            expected="a list of COCO keypoint results, or a COCO data set with `annotations`",
            found=_brief(items.other),
            todo="Export the poses as COCO keypoint results.",
        )
    frames, triples, boxes, scores = (np.concatenate(each) for each in zip(*batches, strict=True))
    if items.is_mapping and np.all(np.isin(triples[..., 2], (0, 1, 2))):
        triples[..., 2] = np.minimum(triples[..., 2], 1)  # visibility: 1 occluded, 2 visible
    confidence = triples[..., 2]
    right = np.asarray((confidence >= 0) & (confidence <= OVERSHOOT), dtype=np.bool_)
    _require_right(path, triples, right, 0, "a confidence from 0 to 1", _CONFIDENCE_TODO)
    return _by_frame(path, frames, triples, boxes, scores)


_Batch = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]
"""Frames (n,), keypoints (n, 17, 3), boxes (n, 4) and scores (n,) of some results."""


def _batches(path: Path, items: Iterable[Any]) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Yield batches of results, each with the index of its first result in the file."""
    batch: list[dict[str, Any]] = []
    for index, result in enumerate(items):
        if type(result) is not dict:
            raise _wrong(path, index, "", "a mapping with image_id and keypoints", _brief(result))
        batch.append(result)
        if len(batch) == BATCH:
            yield index + 1 - BATCH, batch
            batch = []
    if batch:
        yield index + 1 - len(batch), batch


def _read_batch(path: Path, results: list[dict[str, Any]], first: int) -> _Batch:
    frames = _frames(path, results, first)
    triples = _table(path, results, range(len(results)), "keypoints", 3 * _JOINTS, first)
    triples = triples.reshape(-1, _JOINTS, 3)
    certain = f"pixels up to {COORDINATE_LIMIT:g}, finite (a missing joint is 0, 0, 0)"
    near = np.asarray(np.all(np.abs(triples) <= COORDINATE_LIMIT, axis=-1))
    _require_right(path, triples, near, first, certain, _COUNT_TODO)
    boxes = _optional(path, results, "bbox", 4, first)
    scores = _optional(path, results, "score", 1, first)[:, 0]
    return frames, triples.astype(np.float32), boxes, scores


def _frames(path: Path, results: list[dict[str, Any]], first: int) -> NDArray[np.int64]:
    frames = [result.get("image_id") for result in results]
    for index, frame in enumerate(frames, first):
        if type(frame) is not int or not 0 <= frame <= FRAME_LIMIT:
            todo = "Number the pictures from 0 in the order of the video."
            what = "the frame index, a whole number from 0"
            raise _wrong(path, index, "image_id", what, _brief(frame), todo)
    return np.array(frames, dtype=np.int64)


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
    # Check types, since numpy would accept "1" and True as numbers.
    if well_formed and set(map(type, chain.from_iterable(rows))) <= {int, float}:  # type: ignore[arg-type]
        try:
            return np.array(rows, dtype=np.float64).reshape(-1, width)
        except OverflowError:  # an integer beyond float64
            pass
    raise _first_wrong(path, rows, [first + index for index in indices], key, width)


def _first_wrong(
    path: Path, rows: list[Any], indices: Sequence[int], key: str, width: int
) -> InputError:
    what = "51 numbers: x, y, confidence of 17 joints" if key == "keypoints" else f"{width} numbers"
    todo = _COUNT_TODO if key == "keypoints" else "Correct the file."
    for index, row in zip(indices, rows, strict=True):
        if type(row) is not list:
            return _wrong(path, index, key, what, _brief(row), todo)
        if len(row) != width:
            return _wrong(path, index, key, what, f"{len(row)}", todo)
        for place, number in enumerate(row):
            fits = type(number) is float or (type(number) is int and number.bit_length() < 1024)
            if not fits:
                return _wrong(path, index, f"{key}[{place}]", "a number", _brief(number))
    raise AssertionError("called for a table without a fault")


def _require_right(
    path: Path,
    triples: NDArray[np.floating],
    right: NDArray[np.bool_],
    first: int,
    expected: str,
    todo: str,
) -> None:
    if not np.all(right):
        index, joint = (int(i) for i in np.argwhere(~right)[0])
        place = f"keypoints joint {joint} ({COCO17[joint]})"
        found = ", ".join(f"{number:g}" for number in triples[index, joint])
        raise _wrong(path, first + index, place, expected, f"x, y, c = {found}", todo)


def _optional(
    path: Path, results: list[dict[str, Any]], key: str, width: int, first: int
) -> NDArray[np.float64]:
    """Return entry `key` as (results, width) [px], or scores; NaN rows if absent or null."""
    given = [index for index, result in enumerate(results) if result.get(key) is not None]
    values = np.full((len(results), width), np.nan)
    table = _table(path, results, given, key, width, first)
    # The last two of a box are its size; neither they nor a score can be negative.
    fits = (np.abs(table) <= COORDINATE_LIMIT).all(axis=1) & (table[:, -2:] >= 0).all(axis=1)
    if not np.all(fits):
        row = int(np.argmin(fits))
        what = "a finite score from 0" if key == "score" else "x, y, width and height [px]"
        raise _wrong(path, first + given[row], key, what, f"{table[row].tolist()}")
    values[given] = table
    return values


def _by_frame(
    path: Path,
    frames: NDArray[np.int64],
    triples: NDArray[np.float32],
    boxes: NDArray[np.float64],
    scores: NDArray[np.float64],
) -> KeypointDetections:
    found = triples[..., 2] > 0
    confidence = np.where(found, np.minimum(triples[..., 2], 1), np.float32(np.nan))
    keypoints = np.where(found[..., None], triples[..., :2], np.float32(np.nan))
    seen = found.any(axis=1)
    low = np.where(found[..., None], triples[..., :2], np.inf).min(axis=1, initial=np.inf)
    high = np.where(found[..., None], triples[..., :2], -np.inf).max(axis=1, initial=-np.inf)
    corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
    no_box = np.isnan(boxes[:, 0])
    corners[no_box & seen] = np.concatenate([low, high], axis=1)[no_box & seen]
    mean = np.where(found, confidence, 0).sum(axis=1) / np.maximum(found.sum(axis=1), 1)
    scores = np.where(np.isnan(scores) & seen, mean, scores)

    order = np.argsort(frames, kind="stable")
    frame, first, count = np.unique(frames[order], return_index=True, return_counts=True)
    row = np.repeat(np.arange(len(frame)), count)
    slot = np.arange(len(frames)) - np.repeat(first, count)
    most = int(count.max(initial=0))
    if most > PEOPLE_LIMIT:
        raise InputError(
            str(path),
            expected=f"at most {PEOPLE_LIMIT} people per frame",
            found=f"{most} with image_id {frame[np.argmax(count)]}",
            todo="Check image_id, or keep the detections of each image with the highest scores.",
        )
    # A full frame pads all others: a small file could fill the memory.
    limit = min(ARRAY_BYTES, max(PACKED_BYTES, PACKED_RATIO * path.stat().st_size))
    if len(frame) * most * 4 * (3 * _JOINTS + 5) > limit:
        raise InputError(
            str(path),
            expected=f"frames and people that fit into {limit} bytes",
            found=f"{most} people in frame {frame[np.argmax(count)]}",
            todo="Check image_id.",
        )

    def padded(values: NDArray[Any]) -> NDArray[np.float32]:
        dense = np.full((len(frame), most, *values.shape[1:]), np.nan, dtype=np.float32)
        dense[row, slot] = values[order]
        return dense

    return KeypointDetections(
        frame=frame,
        keypoints=padded(keypoints),
        confidence=padded(confidence),
        boxes=padded(corners),
        score=padded(scores),
    )


def _wrong(
    path: Path,
    index: int,
    place: str,
    expected: str,
    found: str,
    todo: str = "Correct the file.",
) -> InputError:
    where = f"{path}: result {index}" + (f", {place}" if place else "")
    return InputError(where, expected=expected, found=found, todo=todo)


def _brief(value: object) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict | list):
        return f"a {'list' if isinstance(value, list) else 'mapping'} of {len(value)}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
