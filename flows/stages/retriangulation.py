"""Stage `retriangulation`: one unit per clip, its joints triangulated by adjusted cameras (B2)."""

from __future__ import annotations

from data_contracts.records import Record
from flows.stage import Match, Stage
from flows.stages import detection, tracking


class RetriangulationSettings(Record):
    """No settings of its own: joints are triangulated with the settings of `triangulation`."""


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the cameras, their detections, the tracks, and the first triangulation."""
    seen = detection.seen_by_cameras(match, unit)
    return (*seen, "bundle_adjustment/cameras", f"tracking/{unit}", f"triangulation/{unit}")


STAGE = Stage(
    name="retriangulation",
    about="place every joint again with the adjusted cameras",
    settings=RetriangulationSettings,
    units=tracking.units,
    inputs=inputs,
    sources=tracking.clip_sources,
    previous_pass_inputs=tracking.filtering_inputs,
    late_inputs=tracking.found_again,
    needs_static_cameras=True,
)
