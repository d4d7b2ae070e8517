"""Stage `retriangulation`: one unit a clip, its joints placed again by adjusted cameras (B2)."""

from __future__ import annotations

from data_contracts.records import Record
from flows import tracking
from flows.stage import Match, Stage


class RetriangulationSettings(Record):
    """None of its own: joints are placed again as `triangulation` placed them."""


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """The cameras, what they brought in, who is who, and how it was triangulated before."""
    cameras = [f"ingest/{camera.id}" for camera in match.folder.spec.static_cameras]
    return (*cameras, "bundle_adjustment/cameras", f"tracking/{unit}", f"triangulation/{unit}")


STAGE = Stage(
    name="retriangulation",
    about="place every joint again with the adjusted cameras",
    settings=RetriangulationSettings,
    units=tracking.units,
    inputs=inputs,
    sources=tracking.clip_sources,
)
