"""Stage `ingest`: one unit per static camera, and one per broadcast view that needs detections.

A unit reads given 2D poses, or else indexes its video, in which `detection` finds people.
"""

from __future__ import annotations

from pydantic import JsonValue, TypeAdapter

from flows.stage import Match, Stage, once_a_match
from worldpose.ingest.footage import footage_clips, footage_size, unit_frames
from worldpose.review.detections import DETECTION_EDITS, DetectionEdit

_EDITS = TypeAdapter(list[DetectionEdit])


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return static cameras, then broadcast views with 2D poses, or with video and key frames.

    Without key frames, the detections of a broadcast camera are not used.
    """
    folder = match.folder
    known = {*folder.detections, *folder.calibrated_views}
    return (
        *(camera.id for camera in folder.spec.static_cameras),
        *(name for name in folder.spec.broadcast_views if name in known),
    )


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the unit's detections or else its video, and its frame mapping to match time.

    Corrections of given detections are included; without them the key is unchanged.
    """
    folder = match.folder
    if unit not in folder.detections:
        return {**video_sources(match, unit), **match.frame_sources(unit)}
    ranges = unit_frames(folder.spec, unit).ranges
    return {
        **match.file_sources("detections", folder.detections[unit]),
        **match.frame_sources(unit),
        "ranges": [[first, count] for first, count in ranges],
        **edits_of(match, unit),
    }


def edits_of(match: Match, camera: str, first: int = 0, count: int = 2**62) -> dict[str, JsonValue]:
    """Return a camera's detection corrections in a frame range; empty if there are none."""
    edits = edits_by_camera(match).get(camera, ())
    said = [edit for edit in edits if first <= edit.frame < first + count]
    return {"edits": _EDITS.dump_python(said, mode="json")} if said else {}


@once_a_match
def edits_by_camera(match: Match) -> dict[str, list[DetectionEdit]]:
    """Return each camera's detection corrections, in the order of their creation."""
    found: dict[str, list[DetectionEdit]] = {}
    for correction in match.corrections:
        edit = correction.edit
        if isinstance(edit, DETECTION_EDITS):
            found.setdefault(edit.camera, []).append(edit)
    return found


def video_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the unit's video, its selected frames, and its required properties."""
    folder = match.folder
    return {
        **match.file_sources("video", folder.videos[unit]),
        "fps": folder.spec.fps * unit_frames(folder.spec, unit).rate,
        "image_size": list(footage_size(folder.spec, unit)),
        "clips": {clip: [first, count] for clip, first, count in footage_clips(folder.spec, unit)},
    }


STAGE = Stage(
    name="ingest",
    about="take in 2D poses and videos",
    units=units,
    sources=sources,
    leaves_out=True,
)
