"""Result of stage `broadcast_pooling`: the broadcast cameras with one common center."""

from data_contracts.arrays import GroupLayout
from data_contracts.broadcast_calibration import BROADCAST_CALIBRATION

_CAMERA = (
    *("focal", "principal_point", "distortion", "rotation", "translation", "image_size"),
    *("center", "covariance", "shared_covariance", "clip_covariance"),
)

BROADCAST_POOLING = GroupLayout(
    stage="broadcast_pooling",
    about="The broadcast camera of a clip, with the center that all clips of the match share.",
    coordinates=BROADCAST_CALIBRATION.coordinates,
    arrays=tuple(BROADCAST_CALIBRATION.layout(name) for name in _CAMERA),
    labels=BROADCAST_CALIBRATION.labels,
    attributes={
        "clip_id": "clip of the match",
        "clips": "clips of the same camera, including this one",
        "distance": "distance of each clip's own center from the common one [standard deviations]",
        "agree": "whether one center explains all clips; otherwise the camera is unchanged",
    },
)
