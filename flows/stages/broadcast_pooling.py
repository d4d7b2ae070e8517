"""Stage `broadcast_pooling`: one unit per clip whose broadcast camera filmed other clips (M1)."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.records import Record
from flows.stage import Match, Stage, once_a_match
from flows.stages import broadcast_calibration


class BroadcastPoolingSettings(Record):
    """No settings: the covariances of the clips decide whether their positions agree."""


@once_a_match
def units(match: Match) -> tuple[str, ...]:
    """Return the clips whose camera is also calibrated in another clip."""
    clips = broadcast_calibration.units(match)
    return tuple(clip for clip in clips if len(_same_camera(match, clip)) > 1)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the camera's results in all its clips."""
    return tuple(f"broadcast_calibration/{clip}" for clip in _same_camera(match, unit))


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """Return the order of the clips."""
    return {"clips": list(_same_camera(match, unit))}


def _same_camera(match: Match, unit: str) -> tuple[str, ...]:
    """Return the calibrated clips of a clip's broadcast camera, including the clip."""
    return _clips_of_cameras(match)[match.folder.spec.clip(unit).broadcast]


@once_a_match
def _clips_of_cameras(match: Match) -> dict[str | None, tuple[str, ...]]:
    """Return the calibrated clips of every broadcast camera."""
    found: dict[str | None, tuple[str, ...]] = {}
    for clip in broadcast_calibration.units(match):
        camera = match.folder.spec.clip(clip).broadcast
        found[camera] = (*found.get(camera, ()), clip)
    return found


STAGE = Stage(
    name="broadcast_pooling",
    about="give the broadcast camera one place in all its clips",
    settings=BroadcastPoolingSettings,
    units=units,
    inputs=inputs,
    sources=sources,
)
