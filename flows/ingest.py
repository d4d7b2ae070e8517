"""Stage `ingest`: one unit a static camera, and one a broadcast clip with given 2D poses."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.records import Record
from flows.stage import Match, Stage
from worldpose.ingest import unit_frames


class IngestSettings(Record):
    """`ingest` takes what it is given; it has no settings."""


def units(match: Match) -> tuple[str, ...]:
    """Static cameras in order, then the broadcast clips that bring 2D poses."""
    spec = match.folder.spec
    return (
        *(camera.id for camera in spec.static_cameras),
        *(clip.id for clip in spec.clips if clip.id in match.folder.detections),
    )


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Nothing: `ingest` is the first stage."""
    return ()


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The unit's detections, and how its frames lie on the match's clock."""
    folder = match.folder
    path = folder.detections[unit].relative_to(folder.folder).as_posix()
    frames = unit_frames(folder.spec, unit)
    return {
        "detections": path,
        "detections_sha256": match.registration.digest_of(path),
        "first_frame": frames.first,
        "frame_count": frames.count,
        "offset_frames": frames.offset,
    }


STAGE = Stage(
    name="ingest",
    about="take in 2D poses",
    settings=IngestSettings,
    units=units,
    inputs=inputs,
    sources=sources,
)
