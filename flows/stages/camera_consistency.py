"""Stage `camera_consistency`: one unit per clip, from all static cameras and their detections."""

from __future__ import annotations

from pydantic import JsonValue

from flows.stage import Match, Stage
from flows.stages import tracking
from worldpose.camera_consistency.settings import ConsistencySettings


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the clip, whether it has a pitch, stated clock offsets, stills of given cameras."""
    spec, folder = match.folder.spec, match.folder
    stills: dict[str, JsonValue] = {
        name: match.file_sources("still", still)
        for name, still in folder.stills.items()
        if name in folder.calibrations and folder.pitch is not None
    }
    return {
        **tracking.clip_sources(match, unit),
        **({"stills": stills, "pitch": match.pitch_source} if stills else {}),
        "ground": match.folder.pitch is not None,
        "offset_frames": [
            None if isinstance(camera.offset_frames, tuple) else camera.offset_frames
            for camera in spec.static_cameras
        ],
    }


STAGE = Stage(
    name="camera_consistency",
    about="find cameras that contradict the others",
    settings=ConsistencySettings,
    units=tracking.units,
    inputs=tracking.camera_inputs,
    sources=sources,
    leaves_out=True,
    min_cameras=tracking.MIN_CAMERAS,
    needs_static_cameras=True,
)
