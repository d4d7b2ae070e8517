"""Stage `static_calibration`: one unit per static camera, given, clicked or proposed."""

from __future__ import annotations

from flows.stage import Stage
from flows.stages.proposal import camera_sources, needed_proposals
from worldpose.static_calibration.settings import StaticCalibrationSettings

STAGE = Stage(
    name="static_calibration",
    about="find every static camera from clicked or proposed markings",
    settings=StaticCalibrationSettings,
    units=lambda match: tuple(camera.id for camera in match.folder.spec.static_cameras),
    inputs=needed_proposals,
    sources=camera_sources,
    leaves_out=True,
    needs_static_cameras=True,
)
