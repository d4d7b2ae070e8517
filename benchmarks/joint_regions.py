"""Calibration of stated covariances: true joints inside predicted confidence regions."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from data_contracts.arrays import Flags
from data_contracts.conventions import COCO17, JOINT_GROUPS
from worldpose.errors import InputError
from worldpose.evaluation import EvaluationSettings
from worldpose.evaluation.matching import joint_distances, match_people, select_frames, take_matched
from worldpose.formats import JointTracks


def region_counts(
    prediction: JointTracks,
    reference: JointTracks,
    level: float = 0.95,
    settings: EvaluationSettings | None = None,
) -> dict[str, tuple[int, int]]:
    """Return the number of joints inside their confidence region and in total, per group.

    A region is the ellipsoid of the stated covariance that contains the true joint with probability
    `level` for normal errors: d^T C^-1 d is below the quantile of the chi-square distribution with
    three degrees of freedom. People are matched per frame as for the other metrics.

    Args:
        prediction: estimated joints with covariance.
        reference: true joints; with `views`, only joints seen by enough cameras count.
        level: stated probability, above 0 and below 1.
        settings: gate and views; the defaults if None.

    Raises:
        InputError: the prediction has no covariance.
    """
    settings = settings or EvaluationSettings()
    if prediction.covariance is None:
        raise InputError(
            "prediction",
            expected="joints with covariance",
            found="joints without covariance",
            todo="Export the joints of a run, or evaluate without confidence regions.",
        )
    joints = select_frames(prediction.joints, prediction.frames, reference.frames)
    stated = select_frames(prediction.covariance, prediction.frames, reference.frames)
    match = match_people(joint_distances(joints, reference.joints), settings.match_gate_m)
    error = take_matched(joints, match) - reference.joints
    flat = take_matched(stated.reshape(*stated.shape[:3], 9), match)
    covariance = flat.reshape(*flat.shape[:3], 3, 3)
    known = np.isfinite(error).all(axis=-1) & np.isfinite(covariance).all(axis=(-1, -2))
    counts: Flags = np.asarray(known)
    if reference.views is not None:
        counts &= reference.views >= settings.min_views
    error = np.where(counts[..., None], error, 0.0)
    covariance = np.where(counts[..., None, None], covariance, np.eye(3))
    squared = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)
    inside: Flags = np.asarray(counts & (squared <= chdtri(3, 1.0 - level)))
    found = {}
    for group, parts in JOINT_GROUPS.items():
        some = [index for index, name in enumerate(COCO17) if any(part in name for part in parts)]
        found[group] = (int(inside[..., some].sum()), int(counts[..., some].sum()))
    return found
