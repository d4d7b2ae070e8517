"""Shape from bone lengths.

The paper adds lengths of shape directions; lengths do not add, so here a bone's length is that of
the blended bone. Joint noise makes bones longer, by about its variance over the length; the mean
square of a noisy bone is exactly its squared length plus the trace of the error covariance, so
squares are averaged and the trace is subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17, COCO17_RIGID_BONES
from worldpose.body.keypoints import JOINT_OF_POINT
from worldpose.body.model import BodyModel

DEFINITION_STD_M: Final = 0.02
"""Distance between a detector's definition of a joint and the body model's [m]: no number of frames
makes a bone's length more accurate than this times sqrt(2)."""


@dataclass(frozen=True, eq=False)
class BoneLengths:
    """Lengths of a person's `COCO17_RIGID_BONES`."""

    length: Floats
    """(bones,) [m]; NaN for bones that were never seen."""
    variance: Floats
    """(bones,) [m^2]"""


@dataclass(frozen=True, eq=False)
class Shape:
    """Betas with covariance."""

    betas: Floats
    """(shapes,)"""
    covariance: Floats
    """(shapes, shapes)"""


def measure_bones(joints: Floats, covariance: Floats, correlated_frames: float) -> BoneLengths:
    """Return bone lengths without the contribution of noise, robust over frames.

    Args:
        joints: (frames, 17, 3) [m].
        covariance: (frames, 17, 3, 3) [m^2], true to the joints' errors.
        correlated_frames: frames with correlated errors, which count as one.
    """
    lengths, variances = (np.full(len(COCO17_RIGID_BONES), value) for value in (np.nan, np.inf))
    for index, (a, b) in enumerate(COCO17_RIGID_BONES):
        bone = joints[:, b] - joints[:, a]
        error = covariance[:, a] + covariance[:, b]
        seen = np.isfinite(bone).all(-1) & np.isfinite(error).all((-1, -2))
        if not seen.any():
            continue
        bone, error = bone[seen], error[seen]
        square = (bone**2).sum(-1) - np.trace(error, axis1=-2, axis2=-1)
        # A normal vector's square varies by 4 d'Cd + 2 tr(C C).
        spread = 4.0 * np.einsum("fa,fab,fb->f", bone, error, bone)
        spread = spread + 2.0 * np.einsum("fab,fba->f", error, error) + 1e-12
        # Four robust standard deviations reject gross errors, but no correct tail.
        middle = np.median(square)
        scale = max(1.4826 * float(np.median(np.abs(square - middle))), 1e-9)
        kept = np.abs(square - middle) <= 4.0 * scale
        mean = float(square[kept].mean())
        lengths[index] = np.sqrt(max(mean, 1e-4))
        count = max(kept.sum() / correlated_frames, 1.0)
        variances[index] = max(spread[kept].mean(), scale**2) / count / (4.0 * max(mean, 1e-2))
    return BoneLengths(lengths, variances)


def shorten_limbs(joints: Floats, covariance: Floats) -> Floats:
    """Return joints (frames, 17, 3) [m] with limbs of the true mean length.

    Bodies oriented by noisy joints point along the noisy bones, which are longer than the true ones
    by half the variance across over the length. The covariance (frames, 17, 3, 3) [m^2] is true to
    the joints' errors.
    """
    shortened = joints.copy()
    # Arms and legs of COCO-17, outward.
    for near, middle, far in ((5, 7, 9), (6, 8, 10), (11, 13, 15), (12, 14, 16)):
        for a, b, moved in ((near, middle, (middle, far)), (middle, far, (far,))):
            bone, error = joints[:, b] - joints[:, a], covariance[:, a] + covariance[:, b]
            length = np.linalg.norm(bone, axis=-1)
            along = bone / np.maximum(length, 1e-9)[:, None]
            across = np.trace(error, axis1=-2, axis2=-1) - np.einsum(
                "fa,fab,fb->f", along, error, along
            )
            # Maximum relative shortening of bones [1]: beyond it noise is not small.
            longer = np.minimum(0.5 * across / np.maximum(length, 1e-9), 0.15 * length)
            longer = np.where(np.isfinite(longer), longer, 0.0)
            along = np.where(np.isfinite(along), along, 0.0)
            for joint in moved:
                shortened[:, joint] -= longer[:, None] * along
    return shortened


def fit_shape(model: BodyModel, bones: BoneLengths) -> Shape:
    """Return the most probable betas for bones, with exact lengths of the blended bones.

        beta* = arg min sum_b (l_b - |T_b + D_b beta|)^2 / s_b^2 + |beta|^2

    The paper has an absolute value for the square, lengths linear in beta, and no prior. Without
    bones, betas are 0 with covariance 1. `shapes.solve_shapes` starts here.
    """
    ends = np.array([[JOINT_OF_POINT[COCO17[k]] for k in bone] for bone in COCO17_RIGID_BONES])
    template = model.joint_template[ends[:, 1]] - model.joint_template[ends[:, 0]]
    directions = model.joint_directions[ends[:, 1]] - model.joint_directions[ends[:, 0]]
    seen = np.isfinite(bones.length)
    weight = np.zeros(len(COCO17_RIGID_BONES))
    weight[seen] = 1.0 / (bones.variance[seen] + 2.0 * DEFINITION_STD_M**2)
    betas, precision = np.zeros(model.shapes), np.eye(model.shapes)
    # Lengths are almost linear in the betas: from the third step on nothing changes.
    for _ in range(5):
        blended = template + directions @ betas
        length = np.linalg.norm(blended, axis=-1)
        slope = np.einsum("bc,bcs->bs", blended / length[:, None], directions)
        lacking = np.where(seen, bones.length - length, 0.0)
        precision = np.eye(model.shapes) + slope.T @ (weight[:, None] * slope)
        betas = betas + np.linalg.solve(precision, slope.T @ (weight * lacking) - betas)
    return Shape(betas, np.linalg.inv(precision).astype(np.float64))


def agree(one: Shape, other: Shape, level: float = 0.001) -> bool:
    """Return whether two shapes can be one person's, by betas b and covariances C.

        (b1 - b2)' (C1 + C2)^-1 (b1 - b2) <= the quantile of chi^2 at 1 - level

    `level` is the share of one person's pairs that are refused.
    On simulated clips it was 1 to 2 for one person, and 230 or more for people 18 cm apart.
    """
    away = one.betas - other.betas
    squared = away @ np.linalg.solve(one.covariance + other.covariance, away)
    return bool(squared <= chdtri(len(away), level))


def pool_shapes(shapes: Sequence[Shape], weights: Sequence[float]) -> Shape:
    """Return one person's shape, of one body model, from clips: information-weighted means.

    Every covariance includes the normal prior of betas, which counts once; `weights` are the
    prior's in each clip [1], `prior_weight` of the settings. Clips count as independent, although
    the detector's offsets are the same in all of them.
    """
    further = max(weights) - sum(weights)
    precisions = [np.linalg.inv(shape.covariance) for shape in shapes]
    precision = sum(precisions, start=further * np.eye(len(shapes[0].betas)))
    weighted = [own @ shape.betas for own, shape in zip(precisions, shapes, strict=True)]
    covariance = np.linalg.inv(precision).astype(np.float64)
    return Shape(covariance @ np.sum(weighted, axis=0), covariance)
