"""Stages `triangulation` and `retriangulation`: one unit per clip, from its tracks."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection, tracking
from worldpose.triangulation.settings import TriangulationSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return every static camera, its detections, and the tracks."""
    return (*tracking.camera_inputs(match, unit), f"tracking/{unit}")


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return those of tracking's clip, and the frames of all clips, which share the maximum."""
    frames = sum(clip.frame_count for clip in match.folder.spec.clips)
    return {**tracking.clip_sources(match, unit), "match_frames": frames}


STAGE = Stage(
    name="triangulation",
    about="place every joint from the cameras that agree",
    settings=TriangulationSettings,
    units=tracking.units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=tracking.inputs_from_before,
    late_inputs=detection.again_by_cameras,
    needs_static_cameras=True,
)


def adjusted_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the adjusted cameras, their detections, and the tracks of a clip."""
    seen = detection.seen_by_cameras(match, unit)
    return (*seen, "bundle_adjustment/cameras", f"tracking/{unit}")


def retriangulation_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the adjusted cameras, their detections, the tracks, and the first triangulation."""
    return (*adjusted_inputs(match, unit), f"triangulation/{unit}")


RETRIANGULATION = Stage(
    name="retriangulation",
    task_file="triangulation",
    about="place every joint again with the adjusted cameras",
    units=tracking.units,
    inputs=retriangulation_inputs,
    sources=tracking.clip_sources,
    previous_pass_inputs=tracking.filtering_inputs,
    late_inputs=detection.again_by_cameras,
    needs_static_cameras=True,
)
