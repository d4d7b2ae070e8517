"""Stage `tracking`: one unit per clip, from all static cameras."""

from functools import partial
from typing import Final

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection
from worldpose.ingest.footage import unit_frames
from worldpose.review.identities import TRACK_EDITS
from worldpose.tracking.settings import TrackingSettings

MIN_CAMERAS: Final = 2
"""Minimum number of static cameras for triangulation [1]."""


def units(match: Match) -> tuple[str, ...]:
    """Return the clips; none without static cameras."""
    clips = match.folder.spec.clips if match.has_static_cameras else ()
    return tuple(clip.id for clip in clips)


def filtering_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the filtering results of the clip's detections; none without static cameras."""
    return (f"filtering/{unit}",) if match.has_static_cameras else ()


def camera_inputs(match: Match, clip_id: str) -> tuple[str, ...]:
    """Return the results with every static camera and its detections in one clip."""
    cameras = [camera.id for camera in match.folder.spec.static_cameras]
    known = (f"static_calibration/{camera}" for camera in cameras)
    return (*detection.seen_by_cameras(match, clip_id), *known)


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, its pitch, the roster size, and merges and splits of tracks.

    Without such corrections the key is the tracker's alone; names change no result.
    """
    said: list[JsonValue] = [
        correction.edit.model_dump(mode="json")
        for correction in match.corrections
        if isinstance(correction.edit, TRACK_EDITS) and correction.edit.clip == unit
    ]
    pitch = match.folder.pitch
    size = {"template", "length", "width", "crown", "end_fall"}
    # Other sizes of markings than the template's allow a smaller pitch.
    size |= {"dimensions"} if pitch is not None and pitch.dimensions else set()
    return {
        **({"identities": said} if said else {}),
        **clip_sources(match, unit),
        "pitch": None if pitch is None else pitch.model_dump(include=size),
        "people": match.folder.spec.max_people,
    }


def clip_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip's frames, the clock, the cameras in order, and their detections."""
    spec = match.folder.spec
    clip = spec.clip(unit)
    return {
        **clock_sources(match),
        "cameras": [camera.id for camera in spec.static_cameras],
        "seen": list(detection.seen_by_cameras(match, unit)),
        "first_frame": clip.first_frame,
        "frame_count": clip.frame_count,
        "fps": spec.fps,
    }


def clock_sources(match: Match) -> dict[str, JsonValue]:
    """Return offset and rate of each static camera; none if all show whole match frames."""
    spec = match.folder.spec
    clocks = [unit_frames(spec, camera.id) for camera in spec.static_cameras]
    is_whole = all(isinstance(each.offset, int) and each.rate == 1.0 for each in clocks)
    return {} if is_whole else {"clocks": [each.clock for each in clocks]}


of_clips = partial(
    Stage,
    units=units,
    previous_pass_inputs=filtering_inputs,
    late_inputs=detection.again_by_cameras,
    needs_static_cameras=True,
)
"""A stage with one unit per clip, without what the previous iteration rejected."""


def inputs_from_before(match: Match, unit: str) -> tuple[str, ...]:
    """Return cameras adjusted to people, and the filtering results."""
    return ("bundle_adjustment/cameras", *filtering_inputs(match, unit))


STAGE = of_clips(
    name="tracking",
    about="identify people across cameras and over time",
    settings=TrackingSettings,
    inputs=camera_inputs,
    sources=sources,
    previous_pass_inputs=inputs_from_before,
    min_cameras=MIN_CAMERAS,
)
