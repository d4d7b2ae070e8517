"""Stage `broadcast_calibration`: one unit per clip with key frames, clicked or proposed (M1-M6)."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage, once_a_match
from flows.stages import detection
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.ingest.annotations import key_frames_file
from worldpose.ingest.footage import unit_frames


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return the clips with a broadcast video and key frames that are clicked or proposed."""
    return match.folder.calibrated_clips


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the broadcast camera's detections.

    With static cameras also the people fitted to them, and the pitch's surface that they show.
    """
    fitted: tuple[str, ...] = ()
    if match.has_static_cameras:
        fitted = (f"body_fitting/{unit}", "bundle_adjustment/cameras")
    return (*detection.seen_in_broadcast(match, unit), *fitted)


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the video, its frame mapping to match time, the key frames and the pitch.

    Clicks are listed under the file's name, by frame and marking, so that a difference between two
    runs names the file, the frame and the point.
    """
    folder = match.folder
    video = folder.videos[unit]
    path = video.relative_to(folder.folder).as_posix()
    frames = unit_frames(folder.spec, unit)
    clicked: dict[str, JsonValue] = {
        str(key.frame): {
            "points": {point.name: list(point.xy) for point in key.markings.points},
            "drawn": {
                marking.name: [[x, y] for x, y in marking.xy] for marking in key.markings.drawn
            },
        }
        for key in (folder.key_frames[unit].key_frames if unit in folder.key_frames else ())
    }
    proposed = {"side": folder.broadcast_side(unit)} if unit in folder.proposed_clips else {}
    return {
        "video": path,
        "video_sha256": match.registration.digest_of(path),
        "key_frames": {key_frames_file(unit): clicked},
        **proposed,
        "first_frame": frames.first,
        "frame_count": frames.count,
        "offset_frames": frames.offset,
        "broadcast_offset_frames": folder.spec.clip(unit).broadcast_offset_frames,
        "fps": folder.spec.fps,
        "pitch": None if folder.pitch is None else folder.pitch.model_dump(mode="json"),
    }


STAGE = Stage(
    name="broadcast_calibration",
    about="follow the broadcast camera from its key frames",
    settings=BroadcastCalibrationSettings,
    units=units,
    inputs=inputs,
    sources=sources,
)
