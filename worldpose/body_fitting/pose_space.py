"""Pose coordinates that keypoints determine, with joint limits and a pose prior.

COCO's 17 points leave many of a body's 69 angles undetermined: the bend of single spine joints,
hands and feet. 30 coordinates remain: bend of the whole spine and of the whole neck, hips, knees,
shoulders and elbows. The other angles follow from them (spine and neck share evenly) or from the
ground (feet).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.body.parameters import BODY_POSE
from worldpose.body.skeletons import JOINT_NAMES

COORDINATES: Final = (
    ("spine1", "spine2", "spine3"),
    ("neck", "head"),
    ("left_hip",),
    ("right_hip",),
    ("left_knee",),
    ("right_knee",),
    ("left_shoulder",),
    ("right_shoulder",),
    ("left_elbow",),
    ("right_elbow",),
)
"""Joints that share a rotation evenly; three coordinates each."""
SIZE: Final = 3 * len(COORDINATES)

_LIMITS: Final = {
    # Ranges of motion that only contortionists exceed [rad]: lowest, highest by axis. The body's
    # unposed arms point sideways, so a shoulder's third angle hangs the arm.
    "spine": ((-0.6, 1.6), (-1.0, 1.0), (-0.7, 0.7)),
    "neck": ((-1.2, 1.0), (-1.5, 1.5), (-0.8, 0.8)),
    "hip": ((-2.4, 0.8), (-1.0, 1.0), (-0.8, 1.2)),
    "knee": ((-0.05, 2.7), (-0.4, 0.4), (-0.3, 0.3)),
    "shoulder": ((-2.0, 2.0), (-2.0, 1.2), (-2.0, 1.8)),
    "elbow": ((-0.5, 0.5), (-2.7, 0.1), (-0.5, 0.5)),
}
"""Limits of the middle and the left side; the right side mirrors the second and third angle."""


def _limits() -> tuple[Floats, Floats]:
    low, high = np.empty(SIZE), np.empty(SIZE)
    for index, joints in enumerate(COORDINATES):
        name = joints[0]
        kind = next(kind for kind in _LIMITS if kind in name)
        bounds = np.array(_LIMITS[kind])
        if name.startswith("right"):
            bounds[1:] = -bounds[1:, ::-1]
        low[3 * index : 3 * index + 3], high[3 * index : 3 * index + 3] = bounds.T
    return low, high


LOWEST, HIGHEST = _limits()


def _spread() -> Floats:
    matrix = np.zeros((BODY_POSE, SIZE))
    for index, joints in enumerate(COORDINATES):
        for joint in joints:
            row = 3 * (JOINT_NAMES.index(joint) - 1)
            matrix[row : row + 3, 3 * index : 3 * index + 3] = np.eye(3) / len(joints)
    return matrix


SPREAD: Final = _spread()
"""(69, 30): matrix from coordinates to `body_pose` [1]; feet and hands are straight."""
GATHER: Final = (SPREAD.T > 0.0).astype(np.float64)
"""(30, 69): matrix from `body_pose` to coordinates; shared rotations are summed."""


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Pose prior: a normal distribution of the coordinates."""

    mean: Floats
    """(30,) [rad]."""
    precision: Floats
    """(30, 30) [1/rad^2]."""


@functools.cache
def load_pose_prior() -> PosePrior:
    """Return the prior from this project's own simulated football, symmetric left to right.

    0.15 rad, 0.1 rad in knees and elbows, is added in quadrature to every standard deviation:
    simulated people are stiffer than real people.
    """
    with np.load(Path(__file__).parent / "pose_prior.npz", allow_pickle=False) as file:
        mean, covariance = file["mean"], file["covariance"]
    widening = np.full(SIZE, 0.15)
    widening[12:18] = 0.1
    widening[24:30] = 0.1
    return PosePrior(mean, np.linalg.inv(covariance + np.diag(widening**2)))
