"""Poses of people: free parameters, and the 17 joints that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import Floats
from worldpose.simulation.bodies import Body


@dataclass(frozen=True, eq=False)
class Pose:
    """A person's pose per frame, world; direction vectors have length one.

    Attributes:
        pelvis: (frames, 3) mid-hip [m].
        hips_left: (frames, 3) from the mid-hip to the left hip.
        trunk: (frames, 3) from mid-hip to mid-shoulder.
        shoulders_left: (frames, 3) from mid-shoulder to the left shoulder.
        head: (frames, 3, 3), rows: forward, left, up of the head.
        arms: (frames, 2, 2, 3): left and right; upper arm and forearm.
        ankles: (frames, 2, 3) desired ankles [m]; a leg extends at most to its reach.
        knees: (frames, 2, 3) directions of the knees, of any length.
        feet: (frames, 2) directions of standing feet, from the x axis towards y [rad].
    """

    pelvis: Floats
    hips_left: Floats
    trunk: Floats
    shoulders_left: Floats
    head: Floats
    arms: Floats
    ankles: Floats
    knees: Floats
    feet: Floats


def pose_joints(body: Body, pose: Pose) -> Floats:
    """Return joints (frames, 17, 3) [m], world; distances between them are the body's own."""
    joints = np.empty((len(pose.pelvis), 17, 3))
    neck = pose.pelvis + body.trunk * pose.trunk
    joints[:, :5] = neck[:, None] + body.head @ pose.head
    for side, sign in enumerate((1.0, -1.0)):
        shoulder = neck + sign * body.shoulder_half_width * pose.shoulders_left
        joints[:, 5 + side] = shoulder
        joints[:, 7 + side] = shoulder + body.upper_arm * pose.arms[:, side, 0]
        joints[:, 9 + side] = joints[:, 7 + side] + body.forearm * pose.arms[:, side, 1]
        hip = pose.pelvis + sign * body.hip_half_width * pose.hips_left
        joints[:, 11 + side] = hip
        joints[:, 13 + side], joints[:, 15 + side] = _leg(
            body, hip, pose.ankles[:, side], pose.knees[:, side]
        )
    return joints


def unit(vectors: Floats) -> Floats:
    """Return vectors (..., 3) of length one in the same direction."""
    of_length_one: Floats = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return of_length_one


def level_axes(heading: Floats) -> tuple[Floats, Floats]:
    """Return horizontal unit vectors (frames, 3) forward and to the left."""
    zero = np.zeros_like(heading)
    forward = np.stack([np.cos(heading), np.sin(heading), zero], axis=-1)
    return forward, np.stack([-np.sin(heading), np.cos(heading), zero], axis=-1)


def _leg(body: Body, hip: Floats, ankle: Floats, forward: Floats) -> tuple[Floats, Floats]:
    """Return knee and ankle (frames, 3); an ankle out of reach moves to the hip: the heel rises."""
    along = ankle - hip
    far = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along / far
    # Reach ends smoothly and short of a straight leg, whose knee would snap.
    free, spare = 0.965 * body.leg, 0.03 * body.leg
    beyond = np.maximum(far - free, 0.0)
    reach = np.minimum(far, free) + spare * (1.0 - np.exp(-beyond / spare))
    to_knee = (body.thigh**2 - body.shank**2 + reach**2) / (2.0 * reach)
    aside = np.sqrt(body.thigh**2 - to_knee**2)
    front = unit(forward - (forward * along).sum(-1, keepdims=True) * along)
    return hip + to_knee * along + aside * front, hip + reach * along
