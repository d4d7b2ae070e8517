"""Stage `bundle_adjustment`: one unit per match, all its static cameras and clips."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection, tracking
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return every static camera, its detections, and the tracks of every clip."""
    clips = tracking.units(match)
    people = [f"{stage}/{clip}" for stage in ("tracking", "triangulation") for clip in clips]
    seen = {name: None for clip in clips for name in tracking.camera_inputs(match, clip)}
    return (*seen, *people)


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
    # One unit for all cameras: they do not move, so every clip constrains the same ones.
    units=lambda match: ("cameras",) if match.has_static_cameras else (),
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=lambda match, unit: tuple(
        f"filtering/{clip}" for clip in tracking.units(match)
    ),
    late_inputs=lambda match, unit: tuple(
        name for clip in tracking.units(match) for name in detection.again_by_cameras(match, clip)
    ),
    needs_static_cameras=True,
)
