"""2D poses of one camera from a file: COCO keypoint results (JSON), or their arrays (npz)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from data_contracts.records import FRAME_LIMIT
from worldpose.errors import InputError
from worldpose.ingest.coco_results import read_coco_results
from worldpose.ingest.keypoint_arrays import ARRAY_BYTES, read_keypoint_arrays
from worldpose.ingest.observations import Observations


def read_observations(
    path: Path, first_frame: int | None = None, frame_count: int | None = None
) -> Observations:
    """The people that one camera saw, dense over a range of the camera's own frames.

    Args:
        path: `.json` (see `coco_results`) or `.npz` (see `keypoint_arrays`).
        first_frame: first frame wanted; None = from the first to the last frame in the file.
        frame_count: number of frames wanted, given together with `first_frame`; frames beyond are
            left out, frames that the file lacks have no people.

    Raises:
        InputError: naming file and place: unreadable, not what the form says, or a file whose
            people are all outside the wanted frames.
    """
    people = read_keypoint_arrays(path) if path.suffix == ".npz" else read_coco_results(path)
    seen = people.frame
    if first_frame is None or frame_count is None:
        first_frame = int(seen[0]) if len(seen) else 0
        frame_count = int(seen[-1]) - first_frame + 1 if len(seen) else 0
    elif len(seen) and (seen[-1] < first_frame or seen[0] >= first_frame + frame_count):
        raise InputError(
            str(path),
            expected=f"people in frames {first_frame} to {first_frame + frame_count - 1}",
            found=f"frames {seen[0]} to {seen[-1]}",
            todo="Check the frame numbers, the camera's offset_frames and the clips.",
        )
    return on_frames(path, people, first_frame, frame_count)


def on_frames(path: Path, people: Observations, first_frame: int, frame_count: int) -> Observations:
    """The people of `path` on exactly these frames; a frame that was not seen is all NaN.

    Raises:
        InputError: the frame numbers are beyond belief, or the arrays too large.
    """
    detections, joints = people.confidence.shape[1:]
    frame_bytes = 8 + 4 * (3 * joints + 5) * detections
    if frame_count * frame_bytes > ARRAY_BYTES or abs(first_frame) > FRAME_LIMIT:
        raise InputError(
            str(path),
            expected=f"frame numbers up to {FRAME_LIMIT} and arrays up to {ARRAY_BYTES} bytes",
            found=f"{frame_count} frames from {first_frame} on, with up to {detections} people",
            todo="Check the frame numbers; cut a long match into clips.",
        )
    return people.on_frames(first_frame, frame_count)


def seen_frames(people: Observations) -> tuple[int, int] | None:
    """First and last frame with a person in it; None when there is none."""
    frames = people.frame[np.isfinite(people.confidence).any(axis=(1, 2))]
    return (int(frames[0]), int(frames[-1])) if len(frames) else None
