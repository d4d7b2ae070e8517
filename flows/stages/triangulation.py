"""Stage `triangulation`: one unit per clip, from its tracks and all static cameras (T3, T4)."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import tracking
from worldpose.triangulation.settings import TriangulationSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return every static camera, its detections, and the tracks."""
    return (*tracking.inputs(match, unit), f"tracking/{unit}")


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
    previous_pass_inputs=tracking.again,
    late_inputs=tracking.found_again,
    needs_static_cameras=True,
)
