"""Stage `bundle_adjustment`: one unit per match, all its static cameras and clips."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection, tracking
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings


def units(match: Match) -> tuple[str, ...]:
    """Return one unit for all cameras: they do not move, so every clip constrains the same ones."""
    return ("cameras",) if match.has_static_cameras else ()


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return every static camera, its detections, and the tracks of every clip."""
    clips = tracking.units(match)
    people = [f"{stage}/{clip}" for stage in ("tracking", "triangulation") for clip in clips]
    seen = {name: None for clip in clips for name in tracking.camera_inputs(match, clip)}
    return (*seen, *people)


def inputs_from_before(match: Match, unit: str) -> tuple[str, ...]:
    """Return the filtering results of every clip: keypoints that the bodies rejected."""
    return tuple(
        name for clip in tracking.units(match) for name in tracking.filtering_inputs(match, clip)
    )


def late_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the redetection results of all cameras in every clip."""
    return tuple(
        name for clip in tracking.units(match) for name in detection.again_by_cameras(match, clip)
    )


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clips, the clock, the camera order, and the pitch that clicked points refer to."""
    spec = match.folder.spec
    return {
        **tracking.clock_sources(match),
        "cameras": [camera.id for camera in spec.static_cameras],
        "seen": {clip.id: list(detection.seen_by_cameras(match, clip.id)) for clip in spec.clips},
        "clips": {clip.id: [clip.first_frame, clip.frame_count] for clip in spec.clips},
        "fps": spec.fps,
        "pitch": match.pitch_source,
    }


STAGE = Stage(
    name="bundle_adjustment",
    about="let people and markings adjust the cameras together",
    settings=BundleAdjustmentSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=inputs_from_before,
    late_inputs=late_inputs,
    needs_static_cameras=True,
)
