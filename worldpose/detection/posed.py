"""Keypoints of people in boxes, and occluded people next to them."""

from __future__ import annotations

from data_contracts.arrays import Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.boxes import combine_boxes
from worldpose.detection.interfaces import LooksBeside, People, PoseEstimator
from worldpose.detection.settings import DetectionSettings


def find_poses(
    estimator: PoseEstimator, picture: Image, people: People, settings: DetectionSettings
) -> KeypointDetections:
    """Return the poses of people with the estimator's boxes, then of occluded people next to them.

    Args:
        estimator: of poses.
        picture: the whole frame.
        people: detected people.
        settings: of the stage.
    """
    poses = combine_boxes(people, estimator.estimate(picture, people.boxes))
    if not (settings.find_occluded and isinstance(estimator, LooksBeside)):
        return poses
    occluded = estimator.beside(picture, People.from_detections(poses))
    return KeypointDetections.concatenate([poses, occluded])
