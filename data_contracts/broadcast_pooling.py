"""Result of stage `broadcast_pooling`: the cameras of `broadcast_calibration`, of one place."""

from data_contracts.arrays import GroupLayout
from data_contracts.broadcast_calibration import BROADCAST_CALIBRATION

_CAMERA = (
    *("focal", "principal_point", "distortion", "rotation", "translation", "image_size"),
    *("center", "covariance", "shared_covariance", "clip_covariance"),
)

BROADCAST_POOLING = GroupLayout(
    stage="broadcast_pooling",
    about="A clip's broadcast camera at the place that it has in all clips of the match.",
    coordinates=BROADCAST_CALIBRATION.coordinates,
    arrays=tuple(BROADCAST_CALIBRATION.layout(name) for name in _CAMERA),
    labels=BROADCAST_CALIBRATION.labels,
    attributes={
        "clip_id": "clip of the match",
        "clips": "clips of the same camera, this one among them",
        "distance": "how far each of them is from the place they have in common [standard "
        "deviations]",
        "agree": "whether one place explains all of them; else the camera is as it was",
    },
)
