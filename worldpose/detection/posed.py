"""Keypoints of people in boxes, and occluded people next to them."""

from __future__ import annotations

import numpy as np

from data_contracts.arrays import Image
from worldpose.detection.boxes import seen_closer
from worldpose.detection.interfaces import LooksBeside, People, PoseEstimator, Poses
from worldpose.detection.settings import DetectionSettings


def find_poses(
    estimator: PoseEstimator, picture: Image, people: People, settings: DetectionSettings
) -> tuple[People, Poses]:
    """Return people with the estimator's boxes and poses, then occluded people next to them.

    Args:
        estimator: of poses.
        picture: the whole frame.
        people: detected people.
        settings: of the stage.
    """
    poses = estimator.estimate(picture, people.boxes)
    people = seen_closer(people, poses)
    if not (settings.find_occluded and isinstance(estimator, LooksBeside)):
        return people, poses
    others, theirs = estimator.beside(picture, people)
    return (
        People(
            np.concatenate([people.boxes, others.boxes]),
            np.concatenate([people.scores, others.scores]),
        ),
        Poses(
            np.concatenate([poses.keypoints, theirs.keypoints]),
            np.concatenate([poses.confidence, theirs.confidence]),
        ),
    )
