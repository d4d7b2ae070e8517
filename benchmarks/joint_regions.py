"""Errors of joints by group, lengths of segments, and true joints inside stated regions."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17, JOINT_GROUPS
from worldpose.body_fitting.evidence import body_axes
from worldpose.errors import InputError
from worldpose.evaluation.matching import (
    EvaluationSettings,
    joint_distances,
    match_people,
    select_frames,
    take_matched,
)
from worldpose.formats.joints_file import JointTracks


def group_joints(group: str) -> list[int]:
    """Return the indices of a group's joints in COCO-17."""
    parts = JOINT_GROUPS[group]
    return [index for index, name in enumerate(COCO17) if any(part in name for part in parts)]


def _match(
    prediction: JointTracks, reference: JointTracks, settings: EvaluationSettings
) -> tuple[Floats, Floats | None, Flags]:
    """Return matched joints, their covariance, and which of them count, as the true people."""
    joints = select_frames(prediction.joints, prediction.frames, reference.frames)
    match = match_people(joint_distances(joints, reference.joints), settings.match_gate_m)
    covariance = None
    if prediction.covariance is not None:
        stated = select_frames(prediction.covariance, prediction.frames, reference.frames)
        flat = take_matched(stated.reshape(*stated.shape[:3], 9), match)
        covariance = flat.reshape(*flat.shape[:3], 3, 3)
    found = take_matched(joints, match)
    counts: Flags = np.asarray(np.isfinite(found - reference.joints).all(axis=-1))
    if reference.views is not None:
        counts &= reference.views >= settings.min_views
    return found, covariance, counts


def _subtract_offsets(error: Floats, axes: Floats, counts: Flags) -> Floats:
    """Return errors (frames, persons, joints, 3) less the mean of each joint in a body's axes."""
    counts = counts & np.asarray(np.isfinite(axes).all(axis=(-1, -2)))[..., None]
    axes = np.where(np.isfinite(axes), axes, 0.0)
    own = np.where(counts[..., None], error @ axes, 0.0)
    offset = own.sum(axis=(0, 1)) / np.maximum(counts.sum(axis=(0, 1)), 1)[:, None]
    less: Floats = error - np.einsum("fpab,jb->fpja", axes, offset)
    return less


def group_errors(
    prediction: JointTracks, reference: JointTracks, settings: EvaluationSettings | None = None
) -> dict[str, tuple[float, int]]:
    """Return the sum of distances [mm] and the number of joints per group."""
    found, _, counts = _match(prediction, reference, settings or EvaluationSettings())
    away = np.where(counts, 1e3 * np.linalg.norm(found - reference.joints, axis=-1), 0.0)
    groups = {name: group_joints(name) for name in JOINT_GROUPS}
    return {
        name: (float(away[..., some].sum()), int(counts[..., some].sum()))
        for name, some in groups.items()
    }


def region_counts(
    prediction: JointTracks,
    reference: JointTracks,
    level: float = 0.95,
    settings: EvaluationSettings | None = None,
    *,
    less_offset: bool = False,
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
        less_offset: subtract the mean error of each joint in the axes of the body, since labels may
            mean another point than the detector.

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
    found, covariance, counts = _match(prediction, reference, settings)
    assert covariance is not None
    counts &= np.isfinite(covariance).all(axis=(-1, -2))
    error = np.where(counts[..., None], found - reference.joints, 0.0)
    if less_offset:
        error = _subtract_offsets(error, body_axes(found), counts)
    covariance = np.where(counts[..., None, None], covariance, np.eye(3))
    squared = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).sum(axis=-1)
    inside: Flags = np.asarray(counts & (squared <= chdtri(3, 1.0 - level)))
    groups = {name: group_joints(name) for name in JOINT_GROUPS}
    return {
        name: (int(inside[..., some].sum()), int(counts[..., some].sum()))
        for name, some in groups.items()
    }
