"""Broadcast calibration: a clip's moving camera from a few key frames, clicked or proposed (M1-M6).

Input: clicks in key frames, the clip's frames, people of the static cameras. Output: a camera per
frame with one center, its covariance, and a report.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.broadcast_calibration.calibration import (
        BroadcastCalibration,
        BroadcastClip,
        broadcast_arrays,
        broadcast_attributes,
        calibrate_broadcast,
        camera_before,
        moving_arrays,
        moving_from_arrays,
    )
    from worldpose.broadcast_calibration.key_frames import KnownPeople, propose_key_frames
    from worldpose.broadcast_calibration.moving_camera import MovingCamera
    from worldpose.broadcast_calibration.players import FeedOffset, People, estimate_feed_offset
    from worldpose.broadcast_calibration.report import BroadcastReport
    from worldpose.broadcast_calibration.settings import (
        BroadcastCalibrationSettings,
        BroadcastPrior,
    )
    from worldpose.broadcast_calibration.uncertainty import (
        PooledCenter,
        drawn_to,
        pool_centers,
        static_covariance,
    )

__all__ = [
    "BroadcastCalibration",
    "BroadcastCalibrationSettings",
    "BroadcastClip",
    "BroadcastPrior",
    "BroadcastReport",
    "FeedOffset",
    "KnownPeople",
    "MovingCamera",
    "People",
    "PooledCenter",
    "broadcast_arrays",
    "broadcast_attributes",
    "calibrate_broadcast",
    "camera_before",
    "drawn_to",
    "estimate_feed_offset",
    "moving_arrays",
    "moving_from_arrays",
    "pool_centers",
    "propose_key_frames",
    "static_covariance",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.broadcast_calibration.calibration": (
            "BroadcastCalibration",
            "BroadcastClip",
            "broadcast_arrays",
            "broadcast_attributes",
            "calibrate_broadcast",
            "camera_before",
            "moving_arrays",
            "moving_from_arrays",
        ),
        "worldpose.broadcast_calibration.key_frames": ("KnownPeople", "propose_key_frames"),
        "worldpose.broadcast_calibration.moving_camera": ("MovingCamera",),
        "worldpose.broadcast_calibration.players": (
            "FeedOffset",
            "People",
            "estimate_feed_offset",
        ),
        "worldpose.broadcast_calibration.report": ("BroadcastReport",),
        "worldpose.broadcast_calibration.settings": (
            "BroadcastCalibrationSettings",
            "BroadcastPrior",
        ),
        "worldpose.broadcast_calibration.uncertainty": (
            "PooledCenter",
            "drawn_to",
            "pool_centers",
            "static_covariance",
        ),
    },
)
