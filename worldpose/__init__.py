"""Metric 3D poses of every player from many cameras: the functions that a script needs.

All take and return plain arrays and frozen records, and need neither Prefect, Dask nor a store:

- read: `read_match` a match folder, `read_unit` one camera's 2D poses of it, `read_cameras` a
  calibration file, `read_observations` a file of 2D poses, `read_still` an image, `open_video`;
- calibrate: `calibrate_camera` from clicks on pitch markings, `calibrate_broadcast` a moving
  camera from clicks in key frames;
- people: `detect_people` in images, `track_people` over all cameras;
- 3D: `triangulate_joints` per frame, `reconstruct_joints` smoothed over time, `adjust_cameras` to
  people and markings, `fit_bodies`;
- results: `open_run` of a project, `read_joints`, `write_joints`, `evaluate_joints`.

World: meters, origin at the center spot, x along the touch line, y across, z up. Cameras: OpenCV
axes, `x_cam = R x_world + t`. Arrays: frame, camera, person, joint, coordinate; NaN = missing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from data_contracts.broadcast_calibration import KeyFrame as KeyFrame
    from data_contracts.keypoints import KeypointDetections as KeypointDetections
    from data_contracts.pitch import PitchSpec as PitchSpec
    from data_contracts.static_calibration import ClickedMarkings as ClickedMarkings
    from worldpose.body import find_body as find_body
    from worldpose.body_fitting import BodyFittingSettings as BodyFittingSettings
    from worldpose.body_fitting import ClipEvidence as ClipEvidence
    from worldpose.body_fitting import find_ray_constraints as find_ray_constraints
    from worldpose.body_fitting import fit_bodies as fit_bodies
    from worldpose.broadcast_calibration import (
        BroadcastCalibrationSettings as BroadcastCalibrationSettings,
    )
    from worldpose.broadcast_calibration import BroadcastClip as BroadcastClip
    from worldpose.broadcast_calibration import calibrate_broadcast as calibrate_broadcast
    from worldpose.bundle_adjustment import BundleAdjustmentSettings as BundleAdjustmentSettings
    from worldpose.bundle_adjustment import Clicks as Clicks
    from worldpose.bundle_adjustment import Clip as Clip
    from worldpose.bundle_adjustment import adjust_cameras as adjust_cameras
    from worldpose.detection import DetectionSettings as DetectionSettings
    from worldpose.detection import detect_people as detect_people
    from worldpose.errors import InputError as InputError
    from worldpose.evaluation import EvaluationSettings as EvaluationSettings
    from worldpose.evaluation import evaluate_joints as evaluate_joints
    from worldpose.formats import JointTracks as JointTracks
    from worldpose.formats import read_joints as read_joints
    from worldpose.formats import write_joints as write_joints
    from worldpose.formats.calibration_forms import read_cameras as read_cameras
    from worldpose.geometry import Camera as Camera
    from worldpose.geometry import Rigid as Rigid
    from worldpose.ingest import MatchFolder as MatchFolder
    from worldpose.ingest import read_match as read_match
    from worldpose.ingest import read_observations as read_observations
    from worldpose.ingest import read_unit as read_unit
    from worldpose.ingest.footage import read_still as read_still
    from worldpose.pitch import PitchTemplate as PitchTemplate
    from worldpose.static_calibration import StaticCalibrationSettings as StaticCalibrationSettings
    from worldpose.static_calibration import calibrate_camera as calibrate_camera
    from worldpose.store.store import open_run as open_run
    from worldpose.tracking import TrackingSettings as TrackingSettings
    from worldpose.tracking import track_people as track_people
    from worldpose.triangulation import TriangulationSettings as TriangulationSettings
    from worldpose.triangulation import reconstruct_joints as reconstruct_joints
    from worldpose.triangulation import triangulate_joints as triangulate_joints
    from worldpose.triangulation import undo_swaps as undo_swaps
    from worldpose.video import open_video as open_video

    __version__: str

_MODULES: Final = {
    "BodyFittingSettings": "worldpose.body_fitting",
    "BroadcastCalibrationSettings": "worldpose.broadcast_calibration",
    "BroadcastClip": "worldpose.broadcast_calibration",
    "BundleAdjustmentSettings": "worldpose.bundle_adjustment",
    "Camera": "worldpose.geometry",
    "ClickedMarkings": "data_contracts.static_calibration",
    "Clicks": "worldpose.bundle_adjustment",
    "Clip": "worldpose.bundle_adjustment",
    "ClipEvidence": "worldpose.body_fitting",
    "DetectionSettings": "worldpose.detection",
    "EvaluationSettings": "worldpose.evaluation",
    "InputError": "worldpose.errors",
    "JointTracks": "worldpose.formats",
    "KeyFrame": "data_contracts.broadcast_calibration",
    "KeypointDetections": "data_contracts.keypoints",
    "MatchFolder": "worldpose.ingest",
    "PitchSpec": "data_contracts.pitch",
    "PitchTemplate": "worldpose.pitch",
    "Rigid": "worldpose.geometry",
    "StaticCalibrationSettings": "worldpose.static_calibration",
    "TrackingSettings": "worldpose.tracking",
    "TriangulationSettings": "worldpose.triangulation",
    "adjust_cameras": "worldpose.bundle_adjustment",
    "calibrate_broadcast": "worldpose.broadcast_calibration",
    "calibrate_camera": "worldpose.static_calibration",
    "detect_people": "worldpose.detection",
    "evaluate_joints": "worldpose.evaluation",
    "find_body": "worldpose.body",
    "find_ray_constraints": "worldpose.body_fitting",
    "fit_bodies": "worldpose.body_fitting",
    "open_run": "worldpose.store.store",
    "open_video": "worldpose.video",
    "read_cameras": "worldpose.formats.calibration_forms",
    "read_joints": "worldpose.formats",
    "read_match": "worldpose.ingest",
    "read_observations": "worldpose.ingest",
    "read_still": "worldpose.ingest.footage",
    "read_unit": "worldpose.ingest",
    "reconstruct_joints": "worldpose.triangulation",
    "track_people": "worldpose.tracking",
    "triangulate_joints": "worldpose.triangulation",
    "undo_swaps": "worldpose.triangulation",
    "write_joints": "worldpose.formats",
}
"""Module of each name, imported on first use: `import worldpose` alone takes a few milliseconds."""

__all__ = [
    "BodyFittingSettings",
    "BroadcastCalibrationSettings",
    "BroadcastClip",
    "BundleAdjustmentSettings",
    "Camera",
    "ClickedMarkings",
    "Clicks",
    "Clip",
    "ClipEvidence",
    "DetectionSettings",
    "EvaluationSettings",
    "InputError",
    "JointTracks",
    "KeyFrame",
    "KeypointDetections",
    "MatchFolder",
    "PitchSpec",
    "PitchTemplate",
    "Rigid",
    "StaticCalibrationSettings",
    "TrackingSettings",
    "TriangulationSettings",
    "__version__",
    "adjust_cameras",
    "calibrate_broadcast",
    "calibrate_camera",
    "detect_people",
    "evaluate_joints",
    "find_body",
    "find_ray_constraints",
    "fit_bodies",
    "open_run",
    "open_video",
    "read_cameras",
    "read_joints",
    "read_match",
    "read_observations",
    "read_still",
    "read_unit",
    "reconstruct_joints",
    "track_people",
    "triangulate_joints",
    "undo_swaps",
    "write_joints",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("worldpose")
    if name in _MODULES:
        from importlib import import_module

        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
