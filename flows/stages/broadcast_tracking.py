"""Stage `broadcast_tracking`: one unit per calibrated clip of a match without static cameras."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.records import Record
from flows.stage import Match, Stage, once_a_match
from flows.stages import broadcast_calibration, broadcast_pooling, detection
from worldpose.ingest.footage import unit_frames


class BroadcastTrackingSettings(Record):
    """No settings: covariances of feet and camera, and shirts, decide who is one person."""


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return the clips with a calibrated broadcast camera and detections, and no other camera."""
    if match.has_static_cameras:
        return ()
    clips = broadcast_calibration.units(match)
    return tuple(clip for clip in clips if detection.seen_in_broadcast(match, clip))


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the clip's detections and its camera, also at the pooled position if there is one."""
    pooled = (f"broadcast_pooling/{unit}",) if unit in broadcast_pooling.units(match) else ()
    seen = detection.seen_in_broadcast(match, unit)
    return (*seen, f"broadcast_calibration/{unit}", *pooled)


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, its video and clock, the pitch, and whether there are monocular poses."""
    spec, pitch = match.folder.spec, match.folder.pitch
    frames, video = unit_frames(spec, unit), match.folder.videos[unit]
    path = video.relative_to(match.folder.folder).as_posix()
    return {
        "video": path,
        "video_sha256": match.registration.digest_of(path),
        "first_frame": frames.first,
        "frame_count": frames.count,
        "offset_frames": frames.offset,
        "fps": spec.fps,
        "has_estimates": unit in match.folder.estimates,
        "pitch": None if pitch is None else pitch.model_dump(mode="json"),
    }


STAGE = Stage(
    name="broadcast_tracking",
    about="place the broadcast camera's people on the pitch",
    settings=BroadcastTrackingSettings,
    units=units,
    inputs=inputs,
    sources=sources,
)
