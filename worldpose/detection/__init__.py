"""Detection of people in each camera's frames, with boxes and keypoints (D1-D3).

Inputs: frames in order, detectors and a pose estimator, the calibrated camera and the pitch.
Outputs: `Stretch` chunks of boxes, scores, keypoints and confidences, without the crowd.
"""

from worldpose.detection.interfaces import Detector, People, PoseEstimator, Poses
from worldpose.detection.models import load_detectors, load_pose, weights_of
from worldpose.detection.people import DetectionReport, PeopleFinder, Place, Stretch
from worldpose.detection.settings import DetectionSettings

__all__ = [
    "DetectionReport",
    "DetectionSettings",
    "Detector",
    "People",
    "PeopleFinder",
    "Place",
    "PoseEstimator",
    "Poses",
    "Stretch",
    "load_detectors",
    "load_pose",
    "weights_of",
]
