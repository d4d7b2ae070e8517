"""Reader of COCO keypoint results: a JSON list of people, or a data set with `annotations`.

Per person: `image_id`, the frame index; `keypoints`, x y c of the 17 COCO joints, where c is the
confidence in 0..1 (in a data set it may be COCO's visibility 0, 1, 2) and 0 means missing; `bbox`
(x y width height) and `score` are optional: the defaults are the box of the found joints and their
mean confidence. Within each frame, people keep the file's order.

Reader and writer of 2D poses as npz: the arrays of `KeypointDetections`, faster than JSON.

Members: `frame` (frames,) int64, `keypoints` (frames, detections, 17, 2), `confidence` (frames,
detections, 17), `boxes` (frames, detections, 4) and `score` (frames, detections), all float32 in
little-endian order, NaN where missing (`data_contracts.keypoints`). Points besides COCO-17 are in
`point` (points,), their names as text, `extra_keypoints` (frames, detections, points, 2) and
`extra_confidence` (frames, detections, points); a file has all three or none.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError
from worldpose.formats.archives import (
    PACKED_BYTES,
    PACKED_RATIO,
    Member,
    check_members,
    open_npz,
    read_array,
    require_size,
    write_archive,
    wrong,
)
from worldpose.formats.files import JsonItems, require_file

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
        InputError: the file is unreadable, or has another number of joints, NaN, a confidence
            outside 0..1, no frame index, or too many people per frame; the error names file, result
            and joint.
    """
    items = JsonItems(path, "annotations", JSON_BYTES)
    batches = [_read_batch(path, results, first) for first, results in _batches(path, items)] or [
        _read_batch(path, [], 0)
    ]
    if not items.has_list:
        raise InputError(
            str(path),
            expected="a list of COCO keypoint results, or a COCO data set with `annotations`",
            found=_shorten(items.other),
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
            expected = "a mapping with image_id and keypoints"
            raise _result_error(path, index, "", expected, _shorten(result))
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
            todo = "Number the images from 0 in the order of the video."
            what = "the frame index, a whole number from 0"
            raise _result_error(path, index, "image_id", what, _shorten(frame), todo)
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
    raise _find_error(path, rows, [first + index for index in indices], key, width)


def _find_error(
    path: Path, rows: list[Any], indices: Sequence[int], key: str, width: int
) -> InputError:
    what = "51 numbers: x, y, confidence of 17 joints" if key == "keypoints" else f"{width} numbers"
    todo = _COUNT_TODO if key == "keypoints" else "Correct the file."
    for index, row in zip(indices, rows, strict=True):
        if type(row) is not list:
            return _result_error(path, index, key, what, _shorten(row), todo)
        if len(row) != width:
            return _result_error(path, index, key, what, f"{len(row)}", todo)
        for place, number in enumerate(row):
            fits = type(number) is float or (type(number) is int and number.bit_length() < 1024)
            if not fits:
                return _result_error(path, index, f"{key}[{place}]", "a number", _shorten(number))
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
        raise _result_error(path, first + index, place, expected, f"x, y, c = {found}", todo)


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
        raise _result_error(path, first + given[row], key, what, f"{table[row].tolist()}")
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

    def pad(values: NDArray[Any]) -> NDArray[np.float32]:
        dense = np.full((len(frame), most, *values.shape[1:]), np.nan, dtype=np.float32)
        dense[row, slot] = values[order]
        return dense

    return KeypointDetections(
        frame=frame,
        keypoints=pad(keypoints),
        confidence=pad(confidence),
        boxes=pad(corners),
        score=pad(scores),
    )


def _result_error(
    path: Path,
    index: int,
    place: str,
    expected: str,
    found: str,
    todo: str = "Correct the file.",
) -> InputError:
    where = f"{path}: result {index}" + (f", {place}" if place else "")
    return InputError(where, expected=expected, found=found, todo=todo)


def _shorten(value: object) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict | list):
        return f"a {'list' if isinstance(value, list) else 'mapping'} of {len(value)}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


ARRAY_BYTES: Final = 4 << 30
"""Maximum size of one file's arrays [byte]; two hours of 25 people at 50 Hz are 2 GB."""

PEOPLE_LIMIT: Final = 1000
"""Maximum people per frame of one camera; a stadium's stands in one image have a few hundred."""

COORDINATE_LIMIT: Final = 1e6
"""Maximum absolute coordinate of a keypoint or box corner [px]."""

_BLOCK: Final = 4096
"""Frames per block of checks, which limits their memory."""
_BLOCK_PEOPLE: Final = 100_000
"""Maximum detections per block."""

_MEMBERS: Final = {
    "frame": Member(("frames",), "int", dtype="<i8"),
    "keypoints": Member(("frames", "detections", _JOINTS, 2), "float", dtype="<f4"),
    "confidence": Member(("frames", "detections", _JOINTS), "float", dtype="<f4"),
    "boxes": Member(("frames", "detections", 4), "float", dtype="<f4"),
    "score": Member(("frames", "detections"), "float", dtype="<f4"),
    "point": Member(("points",), "text", required=False),
    "extra_keypoints": Member(
        ("frames", "detections", "points", 2), "float", required=False, dtype="<f4"
    ),
    "extra_confidence": Member(
        ("frames", "detections", "points"), "float", required=False, dtype="<f4"
    ),
}
_EXTRA: Final = ("point", "extra_keypoints", "extra_confidence")
"""Members of points besides COCO-17: all or none."""
POINTS_LIMIT: Final = 1000
"""Maximum number of these points."""


def write_keypoint_arrays(path: Path, people: KeypointDetections) -> None:
    """Write an npz file; the same arrays give the same bytes on every machine."""
    arrays = {"frame": people.frame, **people.arrays()}
    exact = {name: np.asarray(array, _MEMBERS[name].dtype) for name, array in arrays.items()}
    if people.points:
        exact["point"] = np.array(people.points, dtype=np.str_)
    write_archive(path, exact)


def read_keypoint_arrays(path: Path) -> KeypointDetections:
    """Return the people of an npz file as stored; frames rise, possibly with gaps.

    The function checks every declared type, shape and size before it unpacks data.

    Raises:
        InputError: the file is truncated, too large or no npz, has another type, shape or byte
            order, frames that do not rise, infinite values, or a keypoint without confidence; the
            error names file and member.
    """
    require_file(path)
    with open_npz(path) as file:
        infos, sizes = check_members(path, file, _MEMBERS)
        extra = [name for name in _EXTRA if name in infos]
        if extra and len(extra) < len(_EXTRA):
            raise wrong(str(path), f"all of {', '.join(_EXTRA)}, or none", ", ".join(extra))
        if extra and not 0 < sizes["points"] <= POINTS_LIMIT:
            found = str(sizes["points"])
            raise wrong(f"{path}: point", f"1 to {POINTS_LIMIT} names as text", found)
        if sizes["detections"] > PEOPLE_LIMIT:
            raise InputError(
                f"{path}: score",
                expected=f"at most {PEOPLE_LIMIT} people per frame",
                found=f"room for {sizes['detections']}",
                todo="Keep the detections of each frame with the highest scores.",
            )
        require_size(path, infos.values(), ARRAY_BYTES, PACKED_RATIO)
        arrays = {
            name: read_array(path, file, info, _MEMBERS[name]) for name, info in infos.items()
        }
    people = KeypointDetections.from_arrays(arrays)
    if len(set(people.points)) < len(people.points) or set(people.points) & set(COCO17):
        raise wrong(f"{path}: point", "each point once, and none of COCO-17", f"{people.points}")
    _check_values(path, people)
    return people


def _check_values(path: Path, people: KeypointDetections) -> None:
    steps = np.diff(people.frame)
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0)) + 1
        raise wrong(f"{path}: frame[{place}]", "frame numbers that rise", f"{people.frame[place]}")
    if np.any(np.abs(people.frame) > FRAME_LIMIT):
        raise wrong(f"{path}: frame", f"frame numbers up to {FRAME_LIMIT}", "larger ones")
    block = max(1, min(_BLOCK, _BLOCK_PEOPLE // max(1, people.score.shape[1])))
    for start in range(0, len(people.frame), block):
        _check_block(path, start, people[start : start + block])


def _check_block(path: Path, start: int, people: KeypointDetections) -> None:
    found = np.isfinite(people.confidence)
    person = np.any(found, axis=-1)
    unlike = _either(np.isfinite(people.keypoints) != found[..., None])
    far = np.abs(people.keypoints) > COORDINATE_LIMIT
    ordered = ~_either(people.boxes[..., :2] > people.boxes[..., 2:])
    checks = [
        ("keypoints", _either(far), f"pixels up to {COORDINATE_LIMIT:g}"),
        ("keypoints", unlike, "finite exactly where confidence is"),
        (
            "confidence",
            (people.confidence <= 0) | (people.confidence > 1),
            "values in (0, 1], NaN where not found",
        ),
        ("boxes", (np.abs(people.boxes) > COORDINATE_LIMIT).any(axis=-1) | ~ordered, "x0 y0 x1 y1"),
        ("boxes", person & np.isnan(people.boxes).any(axis=-1), "a box for every person"),
        ("score", np.isinf(people.score) | (people.score < 0), "finite values from 0"),
        ("score", person & np.isnan(people.score), "a score for every person"),
    ]
    if people.extra_keypoints is not None and people.extra_confidence is not None:
        there, sure = np.isfinite(people.extra_keypoints), people.extra_confidence
        far = np.abs(people.extra_keypoints) > COORDINATE_LIMIT
        unlike = _either(there != np.isfinite(sure)[..., None])
        checks += [
            ("extra_keypoints", _either(far), f"pixels up to {COORDINATE_LIMIT:g}"),
            ("extra_keypoints", unlike, "finite exactly where extra_confidence is"),
            ("extra_confidence", (sure <= 0) | (sure > 1), "values in (0, 1], NaN where not found"),
            (
                "extra_confidence",
                np.isfinite(sure) & ~person[..., None],
                "points only of a person with a keypoint of COCO-17",
            ),
        ]
    for name, bad, rule in checks:
        if np.any(bad):
            place = tuple(int(i) for i in np.argwhere(bad)[0])
            value = getattr(people, name)[place]
            where = [place[0] + start, *place[1:]]
            raise wrong(f"{path}: {name}{where} (frame {people.frame[place[0]]})", rule, f"{value}")


def _either(pairs: Flags) -> Flags:
    """Return whether one of two flags (..., 2) is set (...); `any` takes several times as long."""
    return np.asarray(pairs[..., 0] | pairs[..., 1])


def read_observations(
    path: str | os.PathLike[str], ranges: Sequence[tuple[int, int]] | None = None
) -> KeypointDetections:
    """Return the detections of one camera, dense over ranges of the camera's own frames.

    Args:
        path: `.json` (`read_coco_results`) or `.npz` (`read_keypoint_arrays`).
        ranges: first frame and number of frames of each range, rising and disjoint; None = one
            range, from the first to the last frame in the file. The result omits frames outside;
            frames that the file lacks have no people.

    Raises:
        InputError: the file is unreadable or invalid, or all people are outside the wanted frames;
            the error names file and place.
    """
    path = Path(path)
    people = (
        read_keypoint_arrays(path) if path.suffix.lower() == ".npz" else read_coco_results(path)
    )
    seen = people.frame
    if ranges is None:
        first = int(seen[0]) if len(seen) else 0
        return on_frames(path, people, [(first, int(seen[-1]) - first + 1 if len(seen) else 0)])
    if len(seen) and not any(((seen >= first) & (seen < first + n)).any() for first, n in ranges):
        wanted = [f"{first} to {first + count - 1}" for first, count in ranges]
        more = f" and {len(wanted) - 5} more ranges" if len(wanted) > 5 else ""
        raise InputError(
            str(path),
            expected=f"people in frames {', '.join(wanted[:5])}{more}",
            found=f"frames {seen[0]} to {seen[-1]}",
            todo="Check the frame numbers, the camera's offset_frames and the clips.",
        )
    return on_frames(path, people, ranges)


def on_frames(
    path: Path, people: KeypointDetections, ranges: Sequence[tuple[int, int]]
) -> KeypointDetections:
    """Return the people of `path` on exactly these frames; missing frames are NaN.

    Raises:
        InputError: the frame numbers or the arrays are too large.
    """
    detections, joints = people.confidence.shape[1:]
    frame_bytes = 8 + 4 * (3 * (joints + len(people.points)) + 5) * detections
    total = sum(count for _, count in ranges)
    farthest = max(abs(first) for first, _ in ranges)
    if total * frame_bytes > ARRAY_BYTES or farthest > FRAME_LIMIT:
        raise InputError(
            str(path),
            expected=f"frame numbers up to {FRAME_LIMIT} and arrays up to {ARRAY_BYTES} bytes",
            found=f"{total} frames from {ranges[0][0]} on, with up to {detections} people",
            todo="Check the frame numbers; cut a long match into clips.",
        )
    wanted = [np.arange(first, first + count, dtype=np.int64) for first, count in ranges]
    return people.reindex(np.concatenate(wanted))


def seen_frames(people: KeypointDetections) -> tuple[int, int] | None:
    """Return the first and last frame with a person; None without people."""
    frames = people.frame[np.isfinite(people.confidence).any(axis=(1, 2))]
    return (int(frames[0]), int(frames[-1])) if len(frames) else None
