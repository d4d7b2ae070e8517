"""Stage `detection`: people in videos; one unit per clip and camera without 2D poses."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.detection import detection_unit, redetection_name
from flows.stage import Match, Stage, once_a_match
from flows.stages import ingest
from worldpose.detection.models import weights_of
from worldpose.detection.settings import DetectionSettings


def seen_by(match: Match, camera_id: str, clip_id: str) -> str:
    """Return the result with a static camera's detections in one clip, given or computed."""
    if camera_id in match.folder.detections:
        return f"ingest/{camera_id}"
    return f"detection/{detection_unit(camera_id, clip_id)}"


def seen_by_cameras(match: Match, clip_id: str) -> tuple[str, ...]:
    """Return `seen_by` of every static camera, in order."""
    return tuple(seen_by(match, each.id, clip_id) for each in match.folder.spec.static_cameras)


def again(match: Match, camera_id: str, clip_id: str) -> tuple[str, ...]:
    """Return the result with a camera's redetected people, if its video is searched again."""
    name = redetection_name(seen_by(match, camera_id, clip_id))
    return (name,) if name else ()


def again_by_cameras(match: Match, clip_id: str) -> tuple[str, ...]:
    """Return `again` of every static camera, in order."""
    cameras = match.folder.spec.static_cameras
    return tuple(name for camera in cameras for name in again(match, camera.id, clip_id))


def seen_in_broadcast(match: Match, view: str) -> tuple[str, ...]:
    """Return the result with the detections of a broadcast view, if there is one."""
    if view in match.folder.detections:
        return (f"ingest/{view}",)
    return (f"detection/{view}",) if view in _units(match) else ()


@once_a_match
def _units(match: Match) -> dict[str, tuple[str, str]]:
    """Return the unit of `ingest` and the clip of each unit, without given 2D poses."""
    folder, views = match.folder, match.folder.spec.broadcast_views
    found = [unit for unit in ingest.units(match) if unit not in folder.detections]
    return {
        unit if unit in views else detection_unit(unit, clip.id): (unit, clip.id)
        for unit in found
        for clip in ((views[unit].clip,) if unit in views else folder.spec.clips)
    }


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the index of the video, and the camera, which tells what is up, and the crowd."""
    footage, _ = _units(match)[unit]
    is_known = _is_on_pitch(match, footage) or footage in match.folder.calibrations
    known = (f"static_calibration/{footage}",) if is_known else ()
    return (f"ingest/{footage}", *known)


def _is_on_pitch(match: Match, footage: str) -> bool:
    """Return whether a video is of a static camera of a match with a pitch."""
    static = {camera.id for camera in match.folder.spec.static_cameras}
    return footage in static and match.folder.pitch is not None


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the video, the clip, the pitch that separates the crowd, given boxes, corrections."""
    footage, clip_id = _units(match)[unit]
    clip, boxes = match.folder.spec.clip(clip_id), match.folder.boxes.get(footage)
    return {
        "camera": footage,
        **match.file_sources("video", match.folder.videos[footage]),
        "first_frame": clip.first_frame,
        "frame_count": clip.frame_count,
        "pitch": match.pitch_source if _is_on_pitch(match, footage) else None,
        **({} if boxes is None else match.file_sources("boxes", boxes)),
        **ingest.edits_of(match, footage, clip.first_frame, clip.frame_count),
    }


def outside(match: Match, settings: DetectionSettings) -> dict[str, JsonValue]:
    """Return digests of the named weights, and versions of the libraries that run them."""
    return {"weights": dict(weights_of(settings))}


STAGE = Stage(
    name="detection",
    about="find people and their keypoints in videos",
    settings=DetectionSettings,
    units=lambda match: tuple(_units(match)),
    inputs=inputs,
    sources=sources,
    external_inputs=outside,
    worker_tag="GPU",
)
