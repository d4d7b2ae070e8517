"""Reader of one camera's 2D poses: COCO keypoint results (JSON), or arrays (npz)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from data_contracts.keypoints import KeypointDetections
from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError
from worldpose.ingest.coco_results import read_coco_results
from worldpose.ingest.keypoint_arrays import ARRAY_BYTES, read_keypoint_arrays


def read_observations(
    path: Path, ranges: Sequence[tuple[int, int]] | None = None
) -> KeypointDetections:
    """Return the detections of one camera, dense over ranges of the camera's own frames.

    Args:
        path: `.json` (see `coco_results`) or `.npz` (see `keypoint_arrays`).
        ranges: first frame and number of frames of each range, rising and disjoint; None = one
            range, from the first to the last frame in the file. The result omits frames outside;
            frames that the file lacks have no people.

    Raises:
        InputError: with file and place: unreadable, invalid, or all people are outside the wanted
            frames.
    """
    people = read_keypoint_arrays(path) if path.suffix == ".npz" else read_coco_results(path)
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
    frame_bytes = 8 + 4 * (3 * joints + 5) * detections
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
