"""Conversion of a calibrated clip to and from the arrays and attributes of its data contract."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data_contracts.broadcast_calibration import FRAME_STATUS
from worldpose.broadcast_calibration.calibration import BroadcastCalibration
from worldpose.broadcast_calibration.moving_camera import CLIP_SIZE, FRAME_SIZE, MovingCamera
from worldpose.broadcast_calibration.uncertainty import Uncertainty
from worldpose.geometry import Camera
from worldpose.geometry.cameras import camera_from_arrays


def broadcast_arrays(calibration: BroadcastCalibration) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a calibrated clip, by name, without the frame numbers."""
    report, before = calibration.report, calibration.before.camera
    return {
        **moving_arrays(calibration.camera, calibration.uncertainty),
        "focal_before": before.focal,
        "principal_point_before": before.principal_point,
        "distortion_before": before.distortion,
        "rotation_before": before.cam_from_world.rotation,
        "translation_before": before.cam_from_world.translation,
        "status": report.status,
        "reprojection_error": report.reprojection_error,
        "marking_rms": report.marking_rms,
        "player_rms": report.player_rms,
        "marking_count": report.marking_count.astype(np.int32),
        "player_count": report.player_count.astype(np.int32),
        "flow_count": report.flow_count.astype(np.int32),
    }


def moving_arrays(moving: MovingCamera, uncertainty: Uncertainty) -> dict[str, NDArray[Any]]:
    """Return the stored arrays of a moving camera and its covariance, by name."""
    camera, covariance = moving.camera, uncertainty.frame
    return {
        "focal": camera.focal,
        "principal_point": camera.principal_point,
        "distortion": camera.distortion,
        "rotation": camera.cam_from_world.rotation,
        "translation": camera.cam_from_world.translation,
        "image_size": moving.image_size,
        "center": moving.center,
        "covariance": covariance[:, :FRAME_SIZE, :FRAME_SIZE],
        "shared_covariance": covariance[:, :FRAME_SIZE, FRAME_SIZE:],
        "clip_covariance": uncertainty.clip,
    }


def camera_before(arrays: Mapping[Any, ArrayLike]) -> Camera:
    """Return the stored camera (frames,) before players and the joint fit."""
    names = ("focal", "principal_point", "distortion", "rotation", "translation")
    stored = {name: arrays[f"{name}_before"] for name in names}
    return camera_from_arrays({**stored, "image_size": arrays["image_size"]})


def moving_from_arrays(arrays: Mapping[str, ArrayLike]) -> tuple[MovingCamera, Uncertainty]:
    """Return the moving camera of stored arrays, and its covariance."""
    names = ("covariance", "shared_covariance", "clip_covariance")
    own, across, shared = (np.asarray(arrays[name]) for name in names)
    whole = np.empty((len(own), FRAME_SIZE + CLIP_SIZE, FRAME_SIZE + CLIP_SIZE))
    whole[:, :FRAME_SIZE, :FRAME_SIZE] = own
    whole[:, :FRAME_SIZE, FRAME_SIZE:] = across
    whole[:, FRAME_SIZE:, :FRAME_SIZE] = np.swapaxes(across, -1, -2)
    whole[:, FRAME_SIZE:, FRAME_SIZE:] = shared
    return MovingCamera.from_batch(camera_from_arrays(arrays)), Uncertainty(whole)


def broadcast_attributes(
    clip_id: str, calibration: BroadcastCalibration, first: int = 0
) -> dict[str, Any]:
    """Return the stored attributes of a calibrated clip, with frame numbers of its video.

    Args:
        clip_id: the clip.
        calibration: its camera.
        first: number of its first frame in its video.
    """
    report, offset = calibration.report, calibration.report.feed_offset
    return {
        "clip_id": clip_id,
        "status_names": list(FRAME_STATUS),
        "key_frames": [first + int(frame) for frame in report.key_frames],
        "refused_key_frames": {str(first + frame): why for frame, why in report.refused.items()},
        "weights": report.weights.model_dump(),
        "feed_offset": None
        if offset is None
        else {
            "frames": offset.frames if offset.determined else None,
            "standard_error": offset.standard_error if offset.determined else None,
            "pairs": offset.pairs,
        },
        "drift": [float(drift) for drift in report.drift],
        "pick_next": [first + frame for frame in report.pick_next],
        "markings_off": _pair(report.markings_off),
        "players_off": _pair(report.players_off),
        "decisions": list(report.decisions),
        "reasons": list(report.reasons),
    }


def _pair(values: tuple[float, float]) -> list[float | None]:
    """Return values for a record, which cannot hold NaN."""
    return [value if np.isfinite(value) else None for value in values]
