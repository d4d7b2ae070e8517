"""Stage `tracking`: one unit a clip, from all static cameras (T1, T2)."""

from __future__ import annotations

from typing import Final

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection
from worldpose.review.identities import IDENTITY_EDITS
from worldpose.tracking import TrackingSettings, people_allowed

MIN_CAMERAS: Final = 2
"""Static cameras from which people can be placed [1]."""


def units(match: Match) -> tuple[str, ...]:
    """The clips."""
    return tuple(clip.id for clip in match.folder.spec.clips)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Every static camera, and whom it saw in the clip."""
    return camera_inputs(match, unit)


def again(match: Match, unit: str) -> tuple[str, ...]:
    """Cameras that agree with people (C6), and what the bodies contradicted (R2)."""
    return ("bundle_adjustment/cameras", *filtered(match, unit))


def filtered(match: Match, unit: str) -> tuple[str, ...]:
    """What the bodies contradicted of the clip's detections."""
    return (f"filtering/{unit}",)


def found_again(match: Match, unit: str) -> tuple[str, ...]:
    """Whom the clip's cameras show besides those who were detected."""
    return detection.again_by_cameras(match, unit)


def camera_inputs(match: Match, clip_id: str) -> tuple[str, ...]:
    """Every static camera, and whom it saw in a clip."""
    cameras = [camera.id for camera in match.folder.spec.static_cameras]
    known = (f"static_calibration/{camera}" for camera in cameras)
    return (*detection.seen_by_cameras(match, clip_id), *known)


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clip, its pitch, how many people the roster allows, and what people said of who is who.

    Without such corrections the key is the tracker's alone.
    """
    said: list[JsonValue] = [
        correction.edit.model_dump(mode="json")
        for correction in match.corrections
        if isinstance(correction.edit, IDENTITY_EDITS) and correction.edit.clip == unit
    ]
    pitch = match.folder.pitch
    return {
        **({"identities": said} if said else {}),
        **clip_sources(match, unit),
        "pitch_size": None if pitch is None else [pitch.length, pitch.width],
        "people": people_allowed(match.folder.spec.roster),
    }


def clip_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clip's place in the match, the clock, the cameras in order, and whom each saw."""
    spec = match.folder.spec
    clip = spec.clip(unit)
    return {
        "cameras": [camera.id for camera in spec.static_cameras],
        "seen": list(detection.seen_by_cameras(match, unit)),
        "first_frame": clip.first_frame,
        "frame_count": clip.frame_count,
        "fps": spec.fps,
    }


STAGE = Stage(
    name="tracking",
    about="find who is who in every camera and over time",
    settings=TrackingSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=again,
    late_inputs=found_again,
    min_cameras=MIN_CAMERAS,
)
