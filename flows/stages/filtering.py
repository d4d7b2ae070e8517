"""Stage `filtering`: one unit per clip, comparing its detections with its bodies (R2)."""

from __future__ import annotations

from flows.stage import Match, Stage
from flows.stages import detection, refitting, tracking
from worldpose.filtering.settings import FilteringSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the last fitted bodies, the cameras, their detections, and the tracks."""
    bodies = "refitting" if unit in refitting.units(match) else "body_fitting"
    seen = detection.seen_by_cameras(match, unit)
    people = (f"tracking/{unit}", f"retriangulation/{unit}", f"{bodies}/{unit}")
    return (*seen, "bundle_adjustment/cameras", f"triangulation/{unit}", *people)


STAGE = Stage(
    name="filtering",
    about="find the keypoints and boxes that bodies contradict",
    settings=FilteringSettings,
    units=tracking.units,
    inputs=inputs,
    sources=tracking.clip_sources,
    previous_pass_inputs=tracking.filtering_inputs,
    late_inputs=tracking.found_again,
    needs_static_cameras=True,
)
