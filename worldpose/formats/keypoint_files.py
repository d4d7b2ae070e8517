"""Reader and writer of 2D poses as npz: the arrays of `KeypointDetections`, faster than JSON.

Members: `frame` (frames,) int64, `keypoints` (frames, detections, 17, 2), `confidence` (frames,
detections, 17), `boxes` (frames, detections, 4) and `score` (frames, detections), all float32 in
little-endian order, NaN where missing (`data_contracts.keypoints`). Points besides COCO-17 are in
`point` (points,), their names as text, `extra_keypoints` (frames, detections, points, 2) and
`extra_confidence` (frames, detections, points); a file has all three or none.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Flags
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError
from worldpose.formats.archives import (
    PACKED_RATIO,
    Member,
    check_members,
    open_npz,
    read_array,
    require_size,
    write_archive,
    wrong,
)
from worldpose.formats.coco_results import read_coco_results
from worldpose.formats.detection_files import read_openpose_folder
from worldpose.formats.files import require_file
from worldpose.formats.keypoint_sets import (
    ARRAY_BYTES,
    COORDINATE_LIMIT,
    PEOPLE_LIMIT,
    Changes,
    PeopleFile,
)

_MEMBERS: Final = {
    "frame": Member(("frames",), "int", dtype="<i8"),
    "keypoints": Member(("frames", "detections", len(COCO17), 2), "float", dtype="<f4"),
    "confidence": Member(("frames", "detections", len(COCO17)), "float", dtype="<f4"),
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


def write_keypoint_arrays(path: Path, people: KeypointDetections) -> None:
    """Write an npz file; the same arrays give the same bytes on every machine."""
    arrays = {"frame": people.frame, **people.arrays()}
    exact = {name: np.asarray(array, _MEMBERS[name].dtype) for name, array in arrays.items()}
    if people.points:
        exact["point"] = np.array(people.points, dtype=np.str_)
    write_archive(path, exact)


def read_keypoint_arrays(path: Path) -> KeypointDetections:
    """Return the people of an npz file as stored; frames rise, possibly with gaps."""
    points_limit = 1000  # maximum number of these points
    require_file(path)
    extra_members = ("point", "extra_keypoints", "extra_confidence")  # all or none
    with open_npz(path) as file:
        infos, sizes = check_members(path, file, _MEMBERS)
        extra = [name for name in extra_members if name in infos]
        if extra and len(extra) < len(extra_members):
            raise wrong(str(path), f"all of {', '.join(extra_members)}, or none", ", ".join(extra))
        if extra and not 0 < sizes["points"] <= points_limit:
            found = str(sizes["points"])
            raise wrong(f"{path}: point", f"1 to {points_limit} names as text", found)
        if sizes["detections"] > PEOPLE_LIMIT:
            expected = f"at most {PEOPLE_LIMIT} people per frame"
            todo = "Keep the detections of each frame with the highest scores."
            raise InputError(f"{path}: score", expected, f"room for {sizes['detections']}", todo)
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
    block_people = 100_000  # maximum detections per block
    steps = np.diff(people.frame)
    if np.any(steps <= 0):
        place = int(np.argmax(steps <= 0)) + 1
        raise wrong(f"{path}: frame[{place}]", "frame numbers that rise", f"{people.frame[place]}")
    if np.any(np.abs(people.frame) > FRAME_LIMIT):
        raise wrong(f"{path}: frame", f"frame numbers up to {FRAME_LIMIT}", "larger ones")
    block_frames = 4096  # frames per block of checks, which limits their memory
    block = max(1, min(block_frames, block_people // max(1, people.score.shape[1])))
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


def read_people(path: Path) -> PeopleFile:
    """Return the people of one camera, and what was changed to read them.

    The file is `.json` (`read_coco_results`), `.npz` (`read_keypoint_arrays`), or a folder with a
    JSON file of OpenPose for each frame (`read_openpose_folder`).
    """
    if path.is_dir():
        return read_openpose_folder(path)
    if path.suffix.lower() == ".npz":
        return PeopleFile(read_keypoint_arrays(path), "COCO-17", Changes())
    return read_coco_results(path)


def read_observations(path: str | os.PathLike[str]) -> KeypointDetections:
    """Return the detections of one camera, dense from the first to the last frame in the file.

    Frames that the file lacks have no people.

    Args:
        path: a file or folder that `read_people` reads.

    Raises:
        InputError: the file is unreadable or invalid; the error names file and place.
    """
    path = Path(path)
    people = read_people(path).people
    first, stop = (int(people.frame[0]), int(people.frame[-1]) + 1) if len(people.frame) else (0, 0)
    return on_frames(path, people, [(first, stop - first)])


def select_ranges(
    path: Path, people: KeypointDetections, ranges: Sequence[tuple[int, int]]
) -> KeypointDetections:
    """Return the people of `path`, dense over ranges of the camera's own frames.

    A range is first frame and number of frames; ranges rise and are disjoint. Frames outside are
    left out; frames that the file lacks have no people. InputError if nobody is left, or too many
    are.
    """
    seen = people.frame
    if len(seen) and not any(((seen >= first) & (seen < first + n)).any() for first, n in ranges):
        wanted = [f"{first} to {first + count - 1}" for first, count in ranges]
        more = f" and {len(wanted) - 5} more ranges" if len(wanted) > 5 else ""
        expected = f"people in frames {', '.join(wanted[:5])}{more}"
        todo = "Check the frame numbers, the camera's offset_frames and the clips."
        raise InputError(str(path), expected, f"frames {seen[0]} to {seen[-1]}", todo)
    return on_frames(path, people, ranges)


def on_frames(
    path: Path, people: KeypointDetections, ranges: Sequence[tuple[int, int]]
) -> KeypointDetections:
    """Return people on exactly these frames, NaN where missing; InputError if too many."""
    detections, joints = people.confidence.shape[1:]
    frame_bytes = 8 + 4 * (3 * (joints + len(people.points)) + 5) * detections
    total = sum(count for _, count in ranges)
    farthest = max(abs(first) for first, _ in ranges)
    if total * frame_bytes > ARRAY_BYTES or farthest > FRAME_LIMIT:
        expected = f"frame numbers up to {FRAME_LIMIT} and arrays up to {ARRAY_BYTES} bytes"
        found = f"{total} frames from {ranges[0][0]} on, with up to {detections} people"
        raise InputError(
            str(path), expected, found, "Check the frame numbers; cut a long match into clips."
        )
    wanted = [np.arange(first, first + count, dtype=np.int64) for first, count in ranges]
    return people.reindex(np.concatenate(wanted))


def seen_frames(people: KeypointDetections) -> tuple[int, int] | None:
    """Return the first and last frame with a person; None without people."""
    frames = people.frame[np.isfinite(people.confidence).any(axis=(1, 2))]
    return (int(frames[0]), int(frames[-1])) if len(frames) else None
