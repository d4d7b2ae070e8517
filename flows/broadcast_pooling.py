"""Stage `broadcast_pooling`: one unit a clip whose broadcast camera filmed others too (M1)."""

from __future__ import annotations

from pydantic import JsonValue

from data_contracts.records import Record
from flows import broadcast_calibration
from flows.stage import Match, Stage


class BroadcastPoolingSettings(Record):
    """None: whether the clips agree is a test of their own covariances."""


def units(match: Match) -> tuple[str, ...]:
    """Clips whose camera is calibrated in another clip too."""
    clips = broadcast_calibration.units(match)
    return tuple(clip for clip in clips if len(_same_camera(match, clip)) > 1)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """The camera in all its clips."""
    return tuple(f"broadcast_calibration/{clip}" for clip in _same_camera(match, unit))


def sources(match: Match, unit: str) -> dict[str, JsonValue]:
    """The clips' order."""
    return {"clips": list(_same_camera(match, unit))}


def _same_camera(match: Match, unit: str) -> tuple[str, ...]:
    """Calibrated clips of a clip's broadcast camera, itself among them."""
    spec = match.folder.spec
    camera = spec.clip(unit).broadcast
    clips = broadcast_calibration.units(match)
    return tuple(clip for clip in clips if spec.clip(clip).broadcast == camera)


STAGE = Stage(
    name="broadcast_pooling",
    about="give the broadcast camera one place in all its clips",
    settings=BroadcastPoolingSettings,
    units=units,
    inputs=inputs,
    sources=sources,
)
