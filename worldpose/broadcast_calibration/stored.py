"""A calibrated clip as the arrays and attributes of `data_contracts.broadcast_calibration`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.broadcast_calibration import FRAME_STATUS
from worldpose.broadcast_calibration.calibrating import BroadcastCalibration
from worldpose.broadcast_calibration.moving_camera import FRAME_SIZE


def broadcast_arrays(calibration: BroadcastCalibration) -> dict[str, NDArray[Any]]:
    """The stored arrays of a calibrated clip, by name, without the frame numbers."""
    moving, report = calibration.camera, calibration.report
    camera = moving.camera
    covariance = calibration.uncertainty.frame
    return {
        "focal": camera.focal,
        "principal_point": camera.principal_point,
        "distortion": camera.distortion,
        "rotation": camera.cam_from_world.rotation,
        "translation": camera.cam_from_world.translation,
        "image_size": moving.image_size,
        "center": moving.center,
        "covariance": covariance[:, :FRAME_SIZE, :FRAME_SIZE],
        "clip_covariance": calibration.uncertainty.clip,
        "status": report.status,
        "reprojection_error": report.reprojection_error,
        "marking_rms": report.marking_rms,
        "player_rms": report.player_rms,
        "marking_count": report.marking_count.astype(np.int32),
        "player_count": report.player_count.astype(np.int32),
        "flow_count": report.flow_count.astype(np.int32),
    }


def broadcast_attributes(clip_id: str, calibration: BroadcastCalibration) -> dict[str, Any]:
    """The stored attributes of a calibrated clip."""
    report = calibration.report
    return {
        "clip_id": clip_id,
        "status_names": list(FRAME_STATUS),
        "key_frames": [int(frame) for frame in report.key_frames],
        "refused_key_frames": {str(frame): why for frame, why in report.refused.items()},
        "weights": report.weights.model_dump(),
        "drift": [float(drift) for drift in report.drift],
        "pick_next": list(report.pick_next),
        "decisions": list(report.decisions),
        "reasons": list(report.reasons),
    }
