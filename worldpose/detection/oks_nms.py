"""Suppression of poses by object keypoint similarity (OKS)."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from data_contracts.arrays import AnyFloats, Floats
from data_contracts.conventions import COCO17_SIGMAS
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.boxes import areas

DOUBT: Final = 0.5
"""Share of its score that a box with the pose of a better box loses [1]."""


def likeness(keypoints: AnyFloats, area: AnyFloats) -> Floats:
    """Return COCO's object keypoint similarity of every pair of poses (people, people) [1].

    Args:
        keypoints: (people, 17, 2) [px]; NaN where not found.
        area: (people,) of their boxes [px^2]; the smaller of a pair counts.
    """
    apart = np.square(keypoints[:, None] - keypoints[None]).sum(axis=3)
    scale = 2.0 * np.minimum(area[:, None], area[None])[..., None]
    alike = np.exp(-apart / (scale * (2.0 * np.array(COCO17_SIGMAS)) ** 2))
    both = np.isfinite(apart)
    count = both.sum(axis=2)
    total = np.where(both, alike, 0.0).sum(axis=2)
    return np.asarray(np.divide(total, count, out=np.zeros_like(total), where=count > 0))


def suppress_poses(
    detections: KeypointDetections, least_keypoint: float, same_pose: float
) -> KeypointDetections:
    """Return the people that have a pose different from that of every better box.

    The more a pose resembles that of a better box, the lower its score falls (soft suppression,
    Bodla, 2017): a person behind another stays, a duplicate ranks last.

    Args:
        detections: (people,) of one image.
        least_keypoint: a keypoint below this confidence was not found [1].
        same_pose: similarity of poses above which two boxes are of one person [1].
    """
    with np.errstate(invalid="ignore"):
        found = detections.confidence >= least_keypoint
        found &= np.isfinite(detections.keypoints).all(axis=2)
    detections = detections.without(~found)
    alike = likeness(detections.keypoints, areas(detections.boxes))
    kept = np.zeros(len(detections.score), dtype=np.bool_)
    score = detections.score.copy()
    for row in np.argsort(-detections.score, kind="stable"):
        most = alike[row, kept].max(initial=0.0)
        kept[row] = found[row].any() and most <= same_pose
        score[row] *= 1.0 - DOUBT * most**2
    return replace(detections, score=score).select(kept)
