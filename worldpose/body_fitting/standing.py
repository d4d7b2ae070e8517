"""Distance of a person from one camera, by the feet that stand.

A body whose image is known can move along its lines of sight alone. Its lower foot then rises or
sinks by the slope of the line of sight, and is on the ground at one distance. With d_t the distance
of the mid-hip at which the lower ankle of frame t has the height of a standing one, and x_t the
true distance,

    d_t = x_t + e_t + l_t / slope_t,   l_t >= 0

Standing feet have a lift l_t of 0; others seem farther away, never nearer. The likelihood of
d_t - x_t is a mixture: the error e_t is normal, and l_t is 0 or exponential. A constant velocity
with normal accelerations ties the frames. The given place is the mean of x_t before any ankle is
seen. The maximum is found by expectation-maximization from the start at which every foot stands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import log_ndtr

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_HIPS
from worldpose.body_fitting.evidence import ANKLES, ankle_height
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.residuals import Pose
from worldpose.geometry.optimize.banded import BandedFactor
from worldpose.tracking.plane.kalman import Motion

POSE_STD_M: Final = 0.05
"""Standard deviation of the hips from the lower ankle along the line of sight in a fitted pose [m]:
0.1 rad of a leg."""
LIFT_M: Final = 0.1
"""Mean height of the lower ankle above a standing one while neither foot stands [m]."""


def find_standing_distance(
    distance: Floats,
    slope: Floats,
    fps: float,
    height_std_m: float,
    place: Floats,
    information: Floats,
) -> tuple[Floats, Floats]:
    """Return the distance of a person (frames,) [m], and its variance (frames,) [m^2].

    At `distance` (frames,) [m], NaN where unknown, the lower ankle would stand, at a height of a
    deviation [m]; `slope` (frames,) [1] is the fall of the line of sight per horizontal metre.
    `place` (frames,) [m] is given, with information (frames,) [1/m^2], 0 where unknown.
    """
    motion, frames = Motion.at(fps), len(distance)
    known = np.isfinite(distance)
    seen = np.where(known, distance, 0.0)
    variance = POSE_STD_M**2 + (height_std_m / slope) ** 2
    step = 1.0 / (motion.drift[2, 2] / fps**2)  # inverse variance of a second difference [1/m^2]
    blocks = np.zeros((3, frames, 1, 1))
    for start, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
        blocks[0, start : max(start, frames - 2 + start)] += factor * step
    blocks[1, : max(0, frames - 2)] -= 2.0 * step
    blocks[1, 1 : max(1, frames - 1)] -= 2.0 * step
    blocks[2, : max(0, frames - 2)] += step
    standing, rate = known.astype(np.float64), slope / LIFT_M
    found, spread = seen, variance
    for _ in range(12):
        weight = standing / (variance * motion.inflation)
        system = blocks.copy()
        system[0, :, 0, 0] += weight + information
        factor_ = BandedFactor.of(system)
        total = weight * seen + information * place
        found = factor_.solve(total[:, None, None])[:, 0, 0]
        spread = factor_.inverse_blocks()[:, 0, 0]
        away, std = seen - found, np.sqrt(variance)
        stands = -0.5 * away**2 / variance - np.log(std * np.sqrt(2.0 * np.pi))
        # Normal plus exponential.
        lifted = np.log(rate) + rate * (0.5 * rate * variance - away)
        lifted += log_ndtr((away - rate * variance) / std)
        # Density of gross errors of keypoints [1/m]: 2 % over 4 m.
        gross = np.log(0.02 / 4.0)
        other = np.logaddexp(lifted, gross - np.log(0.5))
        standing = known / (1.0 + np.exp(np.clip(other - stands, -500.0, 500.0)))
    return found, spread


def stand_on_ground(solver: PoseSolver, pose: Pose, place: Floats) -> Pose:
    """Return a pose with its mid-hip above `place` (frames, 2) [m], lower ankle on the ground."""
    assert solver.ground is not None
    model = solver.chained.model
    pose = replace(pose, transl=np.zeros_like(pose.transl))
    joints = solver.chained.place(pose.parameters())
    xy = place - joints[:, COCO17_HIPS, :2].mean(axis=1)
    feet = joints[:, ANKLES, :2] + xy[:, None]
    floor = solver.ground(feet[..., 0], feet[..., 1]) + ankle_height(model, pose.betas)
    up = (floor - joints[:, ANKLES, 2]).max(axis=1)
    return replace(pose, transl=np.concatenate([xy, up[:, None]], axis=1))
