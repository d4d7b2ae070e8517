"""Stage `body_fitting`: one unit per clip, from its triangulated joints (S1-S3)."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import detection, tracking
from worldpose.body.body_file import digest_of_body, is_open_body
from worldpose.body_fitting.settings import BodyFittingSettings


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the results with triangulated joints, and with every camera's tracked detections."""
    seen = detection.seen_by_cameras(match, unit)
    return (*seen, "bundle_adjustment/cameras", f"tracking/{unit}", f"retriangulation/{unit}")


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, the clock, the camera order, and the pitch that bounds the feet."""
    pitch = match.folder.pitch
    return {
        **tracking.clip_sources(match, unit),
        "pitch": None if pitch is None else pitch.model_dump(mode="json"),
    }


def outside(settings: BodyFittingSettings) -> dict[str, JsonValue]:
    """Return the digest of an installed body model."""
    return digest_of_model(settings.body_model)


def digest_of_model(name: str) -> dict[str, JsonValue]:
    """Return the digest of an installed body model.

    It is None for the open body, which is part of the code and so of the code's digest.
    """
    if is_open_body(name):
        return {"body_model_sha256": None}
    return {"body_model_sha256": digest_of_body(name)}


STAGE = Stage(
    name="body_fitting",
    about="fit a body to every person",
    settings=BodyFittingSettings,
    units=tracking.units,
    inputs=inputs,
    sources=sources,
    previous_pass_inputs=tracking.filtering_inputs,
    late_inputs=tracking.found_again,
    external_inputs=outside,
    needs_static_cameras=True,
)
