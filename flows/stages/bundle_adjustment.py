"""Stage `bundle_adjustment`: one unit a match, all its static cameras and clips (B1-B3)."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection, tracking
from worldpose.bundle_adjustment import BundleAdjustmentSettings


def units(match: Match) -> tuple[str, ...]:
    """The cameras together: they stand still, so that every clip tells of the same ones."""
    return ("cameras",)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Every static camera, whom it saw, and who is where in every clip."""
    clips = tracking.units(match)
    people = [f"{stage}/{clip}" for stage in ("tracking", "triangulation") for clip in clips]
    seen = {name: None for clip in clips for name in tracking.camera_inputs(match, clip)}
    return (*seen, *people)


def again(match: Match, unit: str) -> tuple[str, ...]:
    """What the bodies contradicted of every clip's detections."""
    return tuple(name for clip in tracking.units(match) for name in tracking.filtered(match, clip))


def later(match: Match, unit: str) -> tuple[str, ...]:
    """Whom all cameras show besides those who were detected, in every clip."""
    return tuple(
        name for clip in tracking.units(match) for name in tracking.found_again(match, clip)
    )


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clips, the clock, the order of the cameras, and the pitch that clicked points are of."""
    spec, pitch = match.folder.spec, match.folder.pitch
    return {
        "cameras": [camera.id for camera in spec.static_cameras],
        "seen": {clip.id: list(detection.seen_by_cameras(match, clip.id)) for clip in spec.clips},
        "clips": {clip.id: [clip.first_frame, clip.frame_count] for clip in spec.clips},
        "fps": spec.fps,
        "pitch": None if pitch is None else pitch.model_dump(mode="json"),
    }


STAGE = Stage(
    name="bundle_adjustment",
    about="let people and markings adjust the cameras together",
    settings=BundleAdjustmentSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=again,
    late_inputs=later,
)
