"""Detections and calibration of one unit of a match folder, in match frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import MatchSpec
from worldpose.errors import InputError
from worldpose.ingest.keypoint_files import read_observations
from worldpose.ingest.match_folder import MatchFolder


@dataclass(frozen=True)
class UnitFrames:
    """Match frames of a static camera, or of a clip's broadcast camera.

    Attributes:
        first: first match frame.
        count: number of frames, including those between clips.
        offset: match frame = camera frame - offset.
        ranges: first match frame and number of frames of every interval covered by clips, rising
            and disjoint: only these contain people.
    """

    first: int
    count: int
    offset: int
    ranges: tuple[tuple[int, int], ...] = ()


def unit_frames(spec: MatchSpec, unit_id: str) -> UnitFrames:
    """Return the frames of a unit: all clips of a static camera, the clip of a broadcast camera.

    The function rounds a broadcast offset to the nearest frame; the rest stays in the clip's
    `broadcast_offset_frames`.
    """
    clips = spec.clips
    if unit_id in {clip.id for clip in clips}:
        clip = spec.clip(unit_id)
        clips = (clip,)
        offset = round(clip.broadcast_offset_frames) - clip.first_frame
    else:
        offset = int(spec.camera(unit_id).offset_frames)
    ranges: list[tuple[int, int]] = []
    for first, stop in sorted((c.first_frame, c.first_frame + c.frame_count) for c in clips):
        if ranges and first <= sum(ranges[-1]):
            begin, count = ranges[-1]
            ranges[-1] = (begin, max(begin + count, stop) - begin)
        else:
            ranges.append((first, stop - first))
    first = ranges[0][0]
    return UnitFrames(first, sum(ranges[-1]) - first, offset, tuple(ranges))


def read_unit(
    match: MatchFolder, unit_id: str
) -> tuple[KeypointDetections, CameraCalibration | None]:
    """Return detections and given calibration of a static camera or a clip's broadcast camera.

    Args:
        match: as read by `read_match`.
        unit_id: id of a static camera, or of a clip that names a broadcast camera.

    Returns:
        Detections with `frame` in match frames, and the calibration if given.

    Raises:
        InputError: the match has no such unit, or no or invalid detections for it.
    """
    if unit_id not in match.detections:
        raise InputError(
            str(match.folder / "detections"),
            expected=f"2D poses of {unit_id!r} ({unit_id}.json or {unit_id}.npz)",
            found=f"those of {', '.join(match.detections) or 'none'}",
            todo="Add the file, or correct the name.",
        )
    frames = unit_frames(match.spec, unit_id)
    ranges = [(first + frames.offset, count) for first, count in frames.ranges]
    people = read_observations(match.detections[unit_id], ranges)
    return replace(people, frame=people.frame - frames.offset), match.calibrations.get(unit_id)
