"""Stages of broadcast cameras: one unit per broadcast view, which is a camera in one clip.

`broadcast_calibration` has the views with key frames, clicked or proposed,
`broadcast_pooling` those whose camera filmed other clips, too, and `broadcast_tracking` the
calibrated clips of a match without static cameras.
"""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage, once_a_match
from flows.stages import detection
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings
from worldpose.ingest.annotations import key_frames_file
from worldpose.ingest.match_folder import IDENTIFIED


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return the broadcast views with a video and key frames that are clicked or proposed."""
    return match.folder.calibrated_views


def uncalibrated_warnings(match: Match) -> tuple[str, ...]:
    """Return sentences about views that have a video, or others in their clip, and are not used."""
    folder, said = match.folder, []
    for name, view in folder.spec.broadcast_views.items():
        is_alone = name not in folder.videos and len(view.clip.moving_cameras) < 2
        if name in folder.calibrated_views or is_alone:
            continue
        needed = [] if name in folder.videos else [f"broadcast/{name}.mp4"]
        if folder.pitch is None:
            needed.append("a pitch in place of `pitch: none`")
        elif name not in folder.key_frames:
            needed.append(f"clicks in {key_frames_file(name)} or a stated side")
        said.append(
            f"broadcast camera {view.camera.id} of clip {view.clip.id} is not used: it needs "
            f"{', and '.join(needed)}."
        )
    return tuple(said)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the broadcast camera's detections.

    With static cameras also the people fitted to them, and the pitch's surface that they show.
    """
    fitted: tuple[str, ...] = ()
    if match.has_static_cameras:
        clip = match.folder.spec.broadcast_views[unit].clip.id
        fitted = (f"body_fitting/{clip}", "bundle_adjustment/cameras")
    return (*detection.seen_in_broadcast(match, unit), *fitted)


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the video, its frame mapping to match time, the key frames and the pitch.

    Clicks are listed under the file's name, by frame and marking, so that a difference between two
    runs names the file, the frame and the point.
    """
    folder, view = match.folder, match.folder.spec.broadcast_views[unit]
    known = folder.key_frames[unit].key_frames if unit in folder.key_frames else ()
    clicked: dict[str, JsonValue] = {str(key.frame): key.markings.by_name() for key in known}
    proposed = {"side": view.camera.side} if unit in folder.proposed_views else {}
    given = folder.camera_data.get(unit)
    return {
        **video_sources(match, unit),
        "key_frames": {key_frames_file(unit): clicked},
        **proposed,
        **({} if given is None else match.file_sources("camera_data", given)),
        "broadcast_offset_frames": view.offset,
        **({} if (weight := view.clip.broadcast_smooth_weight) == 1.0 else {"smooth": weight}),
    }


def video_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return a broadcast video, its frame mapping to match time, and the pitch."""
    return {
        **match.file_sources("video", match.folder.videos[unit]),
        **match.frame_sources(unit),
        "fps": match.folder.spec.fps,
        "pitch": match.pitch_source,
    }


STAGE = Stage(
    name="broadcast_calibration",
    about="follow the broadcast camera from its key frames",
    settings=BroadcastCalibrationSettings,
    units=units,
    inputs=inputs,
    sources=sources,
)


@once_a_match
def pooled_clips(match: Match) -> dict[str, tuple[str, ...]]:
    """Return the views whose camera is also calibrated in others, each with all of these views."""
    views = match.folder.spec.broadcast_views
    cameras = {unit: views[unit].camera.id for unit in units(match)}
    of_camera: dict[str, tuple[str, ...]] = {}
    for unit, camera in cameras.items():
        of_camera[camera] = (*of_camera.get(camera, ()), unit)
    return {unit: of_camera[each] for unit, each in cameras.items() if len(of_camera[each]) > 1}


POOLING = Stage(
    name="broadcast_pooling",
    task_file="broadcast_calibration",
    about="give the broadcast camera one place in all its clips",
    units=lambda match: tuple(pooled_clips(match)),
    inputs=lambda match, unit: tuple(
        f"broadcast_calibration/{clip}" for clip in pooled_clips(match)[unit]
    ),
    sources=lambda match, unit: {"clips": list(pooled_clips(match)[unit])},
)


@once_a_match
def clips_without_static_cameras(match: Match) -> tuple[str, ...]:
    """Return the clips with a calibrated broadcast camera and detections, and no other camera."""
    clips = () if match.has_static_cameras else units(match)
    return tuple(clip for clip in clips if detection.seen_in_broadcast(match, clip))


def camera_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return a view's camera, also at the pooled position if there is one, and its detections."""
    pooled = (f"broadcast_pooling/{unit}",) if unit in pooled_clips(match) else ()
    return (*detection.seen_in_broadcast(match, unit), f"broadcast_calibration/{unit}", *pooled)


def tracking_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, its video and clock, the pitch, and whether there are monocular poses.

    Boxes with identities are a source, too.
    """
    boxes = match.folder.boxes.get(unit)
    named = boxes is not None and boxes.suffix == IDENTIFIED
    return {
        **video_sources(match, unit),
        "has_estimates": unit in match.folder.estimates,
        **(match.file_sources("boxes", boxes) if named else {}),
    }


TRACKING = Stage(
    name="broadcast_tracking",
    task_file="broadcast_calibration",
    about="place the broadcast camera's people on the pitch",
    units=clips_without_static_cameras,
    inputs=camera_inputs,
    sources=tracking_sources,
)
