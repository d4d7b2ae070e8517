"""Stage `bundle_adjustment`: one unit a clip, its cameras and people together (B1-B3)."""

from __future__ import annotations

from pydantic import JsonValue

from flows import tracking, triangulation
from flows.stage import Match, Stage
from worldpose.bundle_adjustment import BundleAdjustmentSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Every static camera, what it brought in, who is who, and where everybody is."""
    return (*triangulation.inputs(match, unit), f"triangulation/{unit}")


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clip's place in the match, and the pitch that clicked points are of."""
    pitch = match.folder.pitch
    return {
        **tracking.sources(match, unit),
        "pitch": None if pitch is None else pitch.model_dump(mode="json"),
    }


STAGE = Stage(
    name="bundle_adjustment",
    about="let people and markings adjust the cameras together",
    settings=BundleAdjustmentSettings,
    units=tracking.units,
    inputs=inputs,
    sources=sources,
)
