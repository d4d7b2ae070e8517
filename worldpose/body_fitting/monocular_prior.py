"""Accuracy of monocular poses, and their terms in the objective (S4).

With enough cameras on a person the fit without monocular poses is much more accurate, and their
distance from it is their error. Its mean square, over all people, is their variance elsewhere. So
an inaccurate method gets almost no weight, and an accurate one helps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body_fitting.monocular_poses import MonocularPoses
from worldpose.body_fitting.pose_space import SIZE
from worldpose.geometry import Rigid

DOUBT: Final = 0.25
"""Prior standard deviation of an angle [rad]: 80 mm on a limb of 0.3 m."""
WITNESSES: Final = 5.0
"""Weight of that prior in independent estimates [1]."""
TAIL: Final = 2.5
"""Deviation, root mean square over the angles, at which an estimate has half its weight [standard
deviations]: backs mistaken for fronts."""

FRESH: Final = 0.3
"""Share of an estimate's variance that is independent from frame to frame [1]."""
MEMORY: Final = 2.0
"""Range of known errors in correlation times [1]: farther ones explain a fiftieth of the
variance."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """Monocular poses of one track, with precision."""

    orient: Floats
    """(frames, 3, 3), world from body."""
    angles: Floats
    """(frames, 30) [rad]."""
    used: NDArray[np.bool_]
    """(frames,), frames that count; poses of others may be NaN."""
    precision: Floats
    """(33, 33) [1/rad^2]: of rotations of the body about the world's axes, and angles."""
    witnesses: float
    """Frames with correlated errors, which count as one [1]."""
    left: Floats | float = 1.0
    """(frames,) share of the variance left after correction by known frames (`carry_errors`)
    [1]."""

    def pull(self, orient: Floats, angles: Floats) -> tuple[Floats, Floats, float]:
        """Return matrices (frames, 33, 33), gradient (frames, 33) and cost for a pose.

        Args:
            orient: (frames, 3) [rad].
            angles: (frames, 30) [rad].
        """
        away = deviations(self.orient, self.angles, orient, angles)
        away = np.where(self.used[:, None], away, 0.0)
        surer = 1.0 / np.broadcast_to(self.left, len(away))
        pulled = away @ self.precision * surer[:, None]
        square = (pulled * away).sum(-1)
        tail = TAIL**2 * len(self.precision)
        weight = self.used / (1.0 + square / tail) / self.witnesses
        by_pose = np.broadcast_to(np.eye(3 + SIZE), (len(away), 3 + SIZE, 3 + SIZE)).copy()
        by_pose[:, :3, :3] = np.linalg.solve(left_jacobian(away[:, :3]), left_jacobian(orient))
        held = by_pose.swapaxes(-1, -2) * weight[:, None, None]
        cost = 0.5 * tail * float(np.log1p(square / tail).sum()) / self.witnesses
        matrix = (held * surer[:, None, None]) @ self.precision @ by_pose
        return matrix, (held @ pulled[..., None])[..., 0], cost


def learn_precision(
    glimpses: MonocularPoses,
    orient: Floats,
    angles: Floats,
    sure: NDArray[np.bool_],
    witnesses: float,
) -> Floats:
    """Return the precision (33, 33) [1/rad^2] of a monocular pose.

    Args:
        glimpses: monocular poses of one clip.
        orient: (frames, persons, 3) [rad], of bodies fitted without monocular poses.
        angles: (frames, persons, 30) [rad], of the same.
        sure: (frames, persons), bodies much more accurate than monocular poses.
        witnesses: frames with correlated errors, which count as one.
    """
    there = sure & np.isfinite(glimpses.angles[..., 0]) & np.isfinite(angles[..., 0])
    away = deviations(glimpses.orient[there], glimpses.angles[there], orient[there], angles[there])
    square = WITNESSES * DOUBT**2 + (away**2).sum(axis=0) / witnesses
    return np.diag((WITNESSES + len(away) / witnesses) / square).astype(np.float64)


def carry_errors(
    known: Floats, known_angles: Floats, off: Floats, used: NDArray[np.bool_], lasting: float
) -> tuple[Floats, Floats, Floats]:
    """Return estimates of one person minus their expected errors.

    The errors of a method for a person in an interval with few cameras mostly exist just before and
    after it too, where the fit reveals them (simple kriging).

    Args:
        known: (frames, 3, 3), world from body.
        known_angles: (frames, 30) [rad].
        off: (frames, 33) [rad], from estimates to more accurate fits; NaN without one.
        used: (frames,), estimates to correct.
        lasting: correlation time of errors, to a factor e [frame].

    Returns:
        The first two arguments, corrected, and the share (frames,) of the variance that is left.
    """
    turn, angles, left = known.copy(), known_angles.copy(), np.ones(len(off))
    there = np.flatnonzero(np.isfinite(off).all(axis=-1))
    asked = np.flatnonzero(used)
    reach = MEMORY * lasting
    for block in np.unique(asked // reach):
        at = asked[asked // reach == block]
        near = there[(there >= at[0] - reach) & (there <= at[-1] + reach)]
        if not len(near):
            continue
        apart = [np.abs(rows[:, None] - near) / lasting for rows in (near, at)]
        alike = [(1.0 - FRESH) * np.exp(-away) for away in apart]
        share = np.linalg.solve(alike[0] + FRESH * np.eye(len(near)), alike[1].T).T
        expected = share @ off[near]
        turn[at] = Rigid.from_rotvec(expected[:, :3], np.zeros(3)).rotation @ turn[at]
        angles[at] += expected[:, 3:]
        left[at] = 1.0 - (share * alike[1]).sum(axis=-1)
    return turn, angles, left


def deviations(known: Floats, known_angles: Floats, orient: Floats, angles: Floats) -> Floats:
    """Return rotations about the world's axes and angles (frames, 33) [rad] from known poses."""
    turned = Rigid.from_rotvec(orient, np.zeros(3)).rotation @ known.swapaxes(-1, -2)
    safe = np.where(np.isfinite(turned), turned, np.eye(3))
    return np.concatenate([Rigid(safe, np.zeros(3)).rotvec, angles - known_angles], axis=-1)


def left_jacobian(vectors: Floats) -> Floats:
    """Return the left Jacobians (frames, 3, 3) of axis-angle vectors (frames, 3)."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    axis = vectors / np.maximum(angle[..., 0], 1e-12)
    cross = np.zeros((len(vectors), 3, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[:, b, a], cross[:, a, b] = axis[:, c], -axis[:, c]
    first = np.sinc(angle / np.pi)
    half = 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2
    outer = axis[:, :, None] * axis[:, None, :]
    jacobian: Floats = first * np.eye(3) + (1.0 - first) * outer + half * cross
    return jacobian
