"""Stage `static_calibration`: one unit per static camera, given, clicked or proposed (C1-C5)."""

from __future__ import annotations

from flows.stage import Match, Stage
from flows.stages.proposal import camera_sources, needed_proposals
from worldpose.static_calibration.settings import StaticCalibrationSettings


def units(match: Match) -> tuple[str, ...]:
    """Return the static cameras in order."""
    return tuple(camera.id for camera in match.folder.spec.static_cameras)


def inputs(match: Match, unit: str) -> tuple[str, ...]:
    """Return the proposals of a camera without clicks.

    Where a side is unknown, they are those of all cameras. A camera with clicks has no inputs.
    """
    return needed_proposals(match, unit)


STAGE = Stage(
    name="static_calibration",
    about="find every static camera from clicked or proposed markings",
    settings=StaticCalibrationSettings,
    units=units,
    inputs=inputs,
    sources=camera_sources,
    leaves_out=True,
    needs_static_cameras=True,
)
