"""Stage `retriangulation`: one unit a clip, its joints placed again by adjusted cameras (B2)."""

from __future__ import annotations

from data_contracts.records import Record
from flows.stage import Match, Stage
from flows.stages import detection, tracking


class RetriangulationSettings(Record):
    """None of its own: joints are placed again as `triangulation` placed them."""


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """The cameras, whom they saw, who is who, and how it was triangulated before."""
    seen = detection.seen_by_cameras(match, unit)
    return (*seen, "bundle_adjustment/cameras", f"tracking/{unit}", f"triangulation/{unit}")


STAGE = Stage(
    name="retriangulation",
    about="place every joint again with the adjusted cameras",
    settings=RetriangulationSettings,
    units=tracking.units,
    inputs=inputs,
    sources=tracking.clip_sources,
    previous_pass_inputs=tracking.filtered,
    late_inputs=tracking.found_again,
)
