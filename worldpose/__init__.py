"""Metric 3D poses of every player from many cameras: the functions that a script needs.

All take and return plain arrays and frozen records, and need neither Prefect, Dask nor a store:

- the whole method: `reconstruct` a match folder, see worldpose/pipeline.py, or
  `reconstruct_bodies` from 2D poses and calibrated cameras;
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
    from worldpose.body.body_file import find_body as find_body
    from worldpose.body_fitting.estimate import fit_bodies as fit_bodies
    from worldpose.body_fitting.from_poses import reconstruct_bodies as reconstruct_bodies
    from worldpose.body_fitting.ray_constraints import find_ray_constraints as find_ray_constraints
    from worldpose.body_fitting.results import ClipEvidence as ClipEvidence
    from worldpose.body_fitting.settings import BodyFittingSettings as BodyFittingSettings
    from worldpose.broadcast_calibration.estimate import BroadcastClip as BroadcastClip
    from worldpose.broadcast_calibration.estimate import calibrate_broadcast as calibrate_broadcast
    from worldpose.broadcast_calibration.settings import (
        BroadcastCalibrationSettings as BroadcastCalibrationSettings,
    )
    from worldpose.bundle_adjustment.clip import Clicks as Clicks
    from worldpose.bundle_adjustment.clip import Clip as Clip
    from worldpose.bundle_adjustment.estimate import adjust_cameras as adjust_cameras
    from worldpose.bundle_adjustment.settings import (
        BundleAdjustmentSettings as BundleAdjustmentSettings,
    )
    from worldpose.detection.pipeline import detect_people as detect_people
    from worldpose.detection.settings import DetectionSettings as DetectionSettings
    from worldpose.errors import InputError as InputError
    from worldpose.evaluation.matching import EvaluationSettings as EvaluationSettings
    from worldpose.evaluation.metrics import evaluate_joints as evaluate_joints
    from worldpose.formats.calibration_forms import read_cameras as read_cameras
    from worldpose.formats.joints_file import JointTracks as JointTracks
    from worldpose.formats.joints_file import read_joints as read_joints
    from worldpose.formats.joints_file import write_joints as write_joints
    from worldpose.formats.keypoint_files import read_observations as read_observations
    from worldpose.geometry.cameras import Camera as Camera
    from worldpose.geometry.rigid import Rigid as Rigid
    from worldpose.ingest.footage import read_still as read_still
    from worldpose.ingest.footage import read_unit as read_unit
    from worldpose.ingest.match_folder import MatchFolder as MatchFolder
    from worldpose.ingest.match_folder import read_match as read_match
    from worldpose.pipeline import Reconstruction as Reconstruction
    from worldpose.pipeline import reconstruct as reconstruct
    from worldpose.pitch.template import PitchTemplate as PitchTemplate
    from worldpose.static_calibration.estimate import calibrate_camera as calibrate_camera
    from worldpose.static_calibration.settings import (
        StaticCalibrationSettings as StaticCalibrationSettings,
    )
    from worldpose.store.store import open_run as open_run
    from worldpose.tracking.settings import TrackingSettings as TrackingSettings
    from worldpose.tracking.tracker import track_people as track_people
    from worldpose.triangulation.estimate import reconstruct_joints as reconstruct_joints
    from worldpose.triangulation.estimate import triangulate_joints as triangulate_joints
    from worldpose.triangulation.limb_lengths import undo_swaps as undo_swaps
    from worldpose.triangulation.settings import TriangulationSettings as TriangulationSettings
    from worldpose.video.folder import open_video as open_video

    __version__: str

_MODULES: Final = {
    "BodyFittingSettings": "worldpose.body_fitting.settings",
    "BroadcastCalibrationSettings": "worldpose.broadcast_calibration.settings",
    "BroadcastClip": "worldpose.broadcast_calibration.estimate",
    "BundleAdjustmentSettings": "worldpose.bundle_adjustment.settings",
    "Camera": "worldpose.geometry.cameras",
    "ClickedMarkings": "data_contracts.static_calibration",
    "Clicks": "worldpose.bundle_adjustment.clip",
    "Clip": "worldpose.bundle_adjustment.clip",
    "ClipEvidence": "worldpose.body_fitting.results",
    "DetectionSettings": "worldpose.detection.settings",
    "EvaluationSettings": "worldpose.evaluation.matching",
    "InputError": "worldpose.errors",
    "JointTracks": "worldpose.formats.joints_file",
    "KeyFrame": "data_contracts.broadcast_calibration",
    "KeypointDetections": "data_contracts.keypoints",
    "MatchFolder": "worldpose.ingest.match_folder",
    "PitchSpec": "data_contracts.pitch",
    "PitchTemplate": "worldpose.pitch.template",
    "Reconstruction": "worldpose.pipeline",
    "Rigid": "worldpose.geometry.rigid",
    "StaticCalibrationSettings": "worldpose.static_calibration.settings",
    "TrackingSettings": "worldpose.tracking.settings",
    "TriangulationSettings": "worldpose.triangulation.settings",
    "adjust_cameras": "worldpose.bundle_adjustment.estimate",
    "calibrate_broadcast": "worldpose.broadcast_calibration.estimate",
    "calibrate_camera": "worldpose.static_calibration.estimate",
    "detect_people": "worldpose.detection.pipeline",
    "evaluate_joints": "worldpose.evaluation.metrics",
    "find_body": "worldpose.body.body_file",
    "find_ray_constraints": "worldpose.body_fitting.ray_constraints",
    "fit_bodies": "worldpose.body_fitting.estimate",
    "open_run": "worldpose.store.store",
    "open_video": "worldpose.video.folder",
    "read_cameras": "worldpose.formats.calibration_forms",
    "read_joints": "worldpose.formats.joints_file",
    "read_match": "worldpose.ingest.match_folder",
    "read_observations": "worldpose.formats.keypoint_files",
    "read_still": "worldpose.ingest.footage",
    "read_unit": "worldpose.ingest.footage",
    "reconstruct": "worldpose.pipeline",
    "reconstruct_bodies": "worldpose.body_fitting.from_poses",
    "reconstruct_joints": "worldpose.triangulation.estimate",
    "track_people": "worldpose.tracking.tracker",
    "triangulate_joints": "worldpose.triangulation.estimate",
    "undo_swaps": "worldpose.triangulation.limb_lengths",
    "write_joints": "worldpose.formats.joints_file",
}
"""Module of each name, imported on first use: `import worldpose` alone takes a few milliseconds."""

__all__ = ["__version__", *_MODULES]


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
