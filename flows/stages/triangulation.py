"""Stages `triangulation` and `retriangulation`: one unit per clip, from its tracks."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match
from flows.stages import detection, tracking
from worldpose.triangulation.settings import TriangulationSettings


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return those of tracking's clip, and the frames of all clips, which share the maximum."""
    frames = sum(clip.frame_count for clip in match.folder.spec.clips)
    return {**tracking.clip_sources(match, unit), "match_frames": frames}


STAGE = tracking.of_clips(
    name="triangulation",
    about="place every joint from the cameras that agree",
    settings=TriangulationSettings,
    inputs=lambda match, unit: (*tracking.camera_inputs(match, unit), f"tracking/{unit}"),
    sources=sources,
    previous_pass_inputs=tracking.inputs_from_before,
)


def adjusted_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the adjusted cameras, their detections, and the tracks of a clip."""
    seen = detection.seen_by_cameras(match, unit)
    return (*seen, "bundle_adjustment/cameras", f"tracking/{unit}")


def retriangulation_inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the adjusted cameras, their detections, the tracks, and the first triangulation."""
    return (*adjusted_inputs(match, unit), f"triangulation/{unit}")


RETRIANGULATION = tracking.of_clips(
    name="retriangulation",
    task_file="triangulation",
    about="place every joint again with the adjusted cameras",
    inputs=retriangulation_inputs,
    sources=tracking.clip_sources,
)
