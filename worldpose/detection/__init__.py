"""Detection of people in each camera's frames, with boxes and keypoints (D1-D5).

Inputs: frames in order, detectors and a pose estimator, the calibrated camera and the pitch.
Outputs: `KeypointDetections` in chunks of frames, without the crowd.
"""

from typing import TYPE_CHECKING

from worldpose.lazy_names import import_on_use

if TYPE_CHECKING:
    from worldpose.detection.interfaces import Detector, People, PoseEstimator
    from worldpose.detection.models import (
        load_detectors,
        load_landmarks,
        load_pose,
        load_score_map,
        weights_of,
    )
    from worldpose.detection.pipeline import DetectionReport, PeopleFinder, Place, detect_people
    from worldpose.detection.settings import DetectionSettings

__all__ = [
    "DetectionReport",
    "DetectionSettings",
    "Detector",
    "People",
    "PeopleFinder",
    "Place",
    "PoseEstimator",
    "detect_people",
    "load_detectors",
    "load_landmarks",
    "load_pose",
    "load_score_map",
    "weights_of",
]

__getattr__ = import_on_use(
    __name__,
    {
        "worldpose.detection.interfaces": (
            "Detector",
            "People",
            "PoseEstimator",
        ),
        "worldpose.detection.models": (
            "load_detectors",
            "load_landmarks",
            "load_pose",
            "load_score_map",
            "weights_of",
        ),
        "worldpose.detection.pipeline": (
            "DetectionReport",
            "PeopleFinder",
            "Place",
            "detect_people",
        ),
        "worldpose.detection.settings": ("DetectionSettings",),
    },
)
