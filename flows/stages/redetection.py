"""Stage `redetection`: from the second iteration on, one unit per video and clip (R2)."""

from __future__ import annotations

from collections.abc import Container

from pydantic import JsonValue

from data_contracts.detection import detection_unit
from flows.stage import Match, Stage, once_a_match
from flows.stages import detection, refitting
from worldpose.detection.settings import RedetectionSettings


@once_a_match
def _units(match: Match) -> dict[str, tuple[str, str]]:
    """Return the static camera and the clip of each unit: those with detections from a video."""
    spec = match.folder.spec
    return {
        detection_unit(camera.id, clip.id): (camera.id, clip.id)
        for camera in spec.static_cameras
        for clip in spec.clips
        if detection.again(match, camera.id, clip.id)
    }


def units(match: Match) -> tuple[str, ...]:
    """Return `camera.clip` of static cameras without given 2D poses."""
    return tuple(_units(match))


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the index of the video, and the detections."""
    camera, clip = _units(match)[unit]
    return (f"ingest/{camera}", detection.seen_by(match, camera, clip))


def again(match: Match, unit: str) -> tuple[str, ...]:
    """Return the adjusted cameras, the last fitted bodies, and the filtering results."""
    _, clip = _units(match)[unit]
    bodies = "refitting" if clip in refitting.units(match) else "body_fitting"
    stages = ("tracking", "triangulation", "retriangulation", bodies, "filtering")
    return ("bundle_adjustment/cameras", *(f"{stage}/{clip}" for stage in stages))


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return camera and clip; `detection` has all other sources."""
    camera, clip = _units(match)[unit]
    return {"camera": camera, "clip": clip}


def seen_in(run: Container[str], match: Match, camera_id: str, clip_id: str) -> str:
    """Return the result with all of a static camera's people in a clip that a run used.

    Args:
        run: names of the run's results, as `stage/unit`.
        match: the match.
        camera_id: the static camera.
        clip_id: the clip.
    """
    again = detection.again(match, camera_id, clip_id)
    found = [name for name in again if name in run]
    return found[0] if found else detection.seen_by(match, camera_id, clip_id)


STAGE = Stage(
    name="redetection",
    about="look again for people where bodies say they must be",
    settings=RedetectionSettings,
    units=units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=again,
    first_pass=2,
    worker_tag="GPU",
    needs_static_cameras=True,
)
