"""Stage `tracking`: one unit a clip, from all static cameras (T1, T2)."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from worldpose.tracking import TrackingSettings, people_allowed


def units(match: Match) -> tuple[str, ...]:
    """The clips."""
    return tuple(clip.id for clip in match.folder.spec.clips)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Every static camera, and what it brought in."""
    return camera_inputs(match)


def camera_inputs(match: Match) -> tuple[str, ...]:
    """Every static camera, and what it brought in."""
    cameras = [camera.id for camera in match.folder.spec.static_cameras]
    stages = ("ingest", "static_calibration")
    return tuple(f"{stage}/{camera}" for stage in stages for camera in cameras)


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clip, whether there is a ground to walk on, and how many people the roster allows."""
    return {
        **clip_sources(match, unit),
        "ground": match.folder.pitch is not None,
        "people": people_allowed(match.folder.spec.roster),
    }


def clip_sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clip's place in the match, the clock, and the order of the cameras."""
    spec = match.folder.spec
    clip = spec.clip(unit)
    return {
        "cameras": [camera.id for camera in spec.static_cameras],
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
)
