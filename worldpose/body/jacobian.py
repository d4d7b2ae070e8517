"""Keypoints of a posed body together with their derivatives, for least squares.

Unfolding the kinematic chain writes a keypoint as `transl + pelvis + sum_q R_q a_q`: R_q is the
world rotation of joint q, and a_q is linear in the betas and the pose feature, with constants that
depend on body and keypoint only. So betas move a keypoint by rotated constants, and a rotation of a
joint moves it by the axis times the lever: the sum of the terms of that joint and all below it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.body.keypoints import FoldedKeypoints
from worldpose.body.model import JOINTS, BodyModel, BodyParameters
from worldpose.compiled import compile_kernel


@dataclass(frozen=True, eq=False)
class KeypointJacobian:
    """Keypoints and their derivatives by the parameters; that by `transl` is the identity."""

    keypoints: Floats
    """(..., keypoints, 3) [m], world."""
    betas: Floats
    """(..., keypoints, 3, shapes) [m]; without shapes where they were not asked for."""
    pose: Floats
    """(..., keypoints, 3, 72) [m/rad], of `global_orient` and then `body_pose`."""

    @property
    def global_orient(self) -> Floats:
        """(..., keypoints, 3, 3) [m/rad]."""
        return self.pose[..., :3]

    @property
    def body_pose(self) -> Floats:
        """(..., keypoints, 3, 69) [m/rad]."""
        return self.pose[..., 3:]


@dataclass(frozen=True, eq=False)
class _Turned:
    """Rotations of posed bodies, and the vectors that they rotate."""

    local: Floats
    """(n, 24, 3, 3), relative to the parent."""
    world: Floats
    """(n, 24, 3, 3)"""
    axes: Floats
    """(n, 24, 3, 3), of the angles, as of `_turn_joints`."""
    terms: Floats
    """(n, terms, 3) [m], unturned."""
    origin: Floats
    """(n, 3) [m], world: the unposed pelvis moved by `transl`."""


@dataclass(frozen=True, eq=False)
class ChainedKeypoints:
    """Keypoints as sums of rotated vectors, precomputed for many poses."""

    model: BodyModel
    pelvis: Floats
    """(3, 1 + shapes) [m]: the unposed pelvis by 1 and the betas."""
    vectors: Floats
    """(keypoints, 24, 3, 1 + shapes + pose features) [m]: a_q by 1, betas and pose feature."""

    @classmethod
    def of(cls, keypoints: FoldedKeypoints) -> ChainedKeypoints:
        """Return keypoints of a model, unfolded."""
        model = keypoints.model
        rest = np.concatenate([model.joint_template[..., None], model.joint_directions], axis=-1)
        linear = rest.shape[-1]
        vectors = np.zeros((len(keypoints.joint_shares), JOINTS, *keypoints.basis.shape[1:]))
        # Each keypoint is a mean of joints, with these shares, and of vectors fixed to joints.
        shares = keypoints.joint_shares.copy()
        pairs = keypoints.keypoint, keypoints.joint
        np.add.at(shares, pairs, keypoints.mass)
        np.add.at(vectors, pairs, keypoints.basis)
        fixed = keypoints.mass[:, None, None] * rest[keypoints.joint]
        np.subtract.at(vectors[..., :linear], pairs, fixed)
        # A joint depends on the bones of all joints above it, and a bone rotates with its parent.
        for joint in range(JOINTS - 1, 0, -1):
            parent = model.parents[joint]
            bone = rest[joint] - rest[parent]
            vectors[:, parent, :, :linear] += shares[:, joint, None, None] * bone
            shares[:, parent] += shares[:, joint]
        return cls(model, rest[0], vectors)

    def move_points(self, first: int, joints: NDArray[np.int64], by: Floats) -> ChainedKeypoints:
        """Return the keypoints, with those from index `first` on moved by vectors fixed to joints.

        Joints are (n,), vectors (n, 3) [m], in the axes of the unposed body.
        """
        vectors = self.vectors.copy()
        vectors[first + np.arange(len(joints)), joints, :, 0] += by
        return ChainedKeypoints(self.model, self.pelvis, vectors)

    def place(self, parameters: BodyParameters) -> Floats:
        """Return the keypoints (..., keypoints, 3) [m], world; all NaN where a parameter is."""
        turned = self._turn(parameters)
        keypoint, joint, _, _ = self._terms
        rotated = (turned.world[:, joint] @ turned.terms[..., None])[..., 0]
        own = (keypoint == np.arange(len(self.vectors))[:, None]).astype(np.float64)
        places = own @ rotated + turned.origin[:, None]
        return np.asarray(places.reshape((*parameters.batch_shape, *places.shape[1:])))

    def _turn(self, parameters: BodyParameters) -> _Turned:
        """Return the rotations of poses, and the terms of their keypoints."""
        flat = parameters.flat()
        angles = np.concatenate([flat.global_orient, flat.body_pose], axis=-1)
        local, world, axes = _turn_joints(angles.reshape(-1, JOINTS, 3), self.model.parents)
        feature = np.concatenate([np.ones((len(angles), 1)), flat.betas], axis=-1)
        origin = feature @ self.pelvis.T + flat.transl
        if self._is_corrected:
            away = (local[:, 1:] - np.eye(3)).reshape(len(angles), 9 * (JOINTS - 1))
            feature = np.concatenate([feature, away], axis=-1)
        constants = self._terms[2].reshape(-1, feature.shape[-1])
        terms = (feature @ constants.T).reshape(len(angles), len(self._terms[1]), 3)
        return _Turned(local, world, axes, terms, origin)

    @property
    def _is_corrected(self) -> bool:
        """Whether keypoints also depend on the pose feature."""
        return bool(self.vectors.shape[-1] > 1 + self.model.shapes)

    def differentiate(
        self, parameters: BodyParameters, *, by_betas: bool = True
    ) -> KeypointJacobian:
        """Return the keypoints and their Jacobian; NaN where a parameter is."""
        batch, count = parameters.batch_shape, len(self.vectors)
        turned, shapes = self._turn(parameters), self.model.shapes
        turns, axes = turned.world, turned.axes
        keypoint, joint, _, moves = self._terms
        keypoints, by_pose = _sum_levers(
            turns, axes, turned.terms, keypoint, joint, moves, self.model.parents
        )
        keypoints += turned.origin[:, None]

        frames = len(turns)
        rows = turns.transpose(0, 2, 1, 3)
        if by_betas or self._is_corrected:
            rows = rows.reshape(frames, 3, 3 * JOINTS)
        shaped = np.empty((frames, count, 3, 0))
        if by_betas:
            shaped = (rows @ self._shaping).reshape(frames, 3, count, shapes)
            shaped = shaped.transpose(0, 2, 1, 3) + self.pelvis[:, 1:]
        if self._is_corrected:
            by_feature = np.einsum("nac,cf->naf", rows, self._correctives, optimize=True)
            by_feature = by_feature.reshape(frames, 3, count, JOINTS - 1, 9)
            own = _own_change(turned.local, turns, axes, self.model.parents)
            by_pose[..., 3:] += np.einsum(
                "nakjf,njfd->nkajd", by_feature, own, optimize=True
            ).reshape(by_pose[..., 3:].shape)
        return KeypointJacobian(
            keypoints.reshape((*batch, count, 3)),
            shaped.reshape((*batch, count, 3, shaped.shape[-1])),
            by_pose.reshape((*batch, count, 3, 3 * JOINTS)),
        )

    @cached_property
    def _terms(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, NDArray[np.bool_]]:
        """Keypoint, joint (terms,) and constants (terms, 3, features) of every nonzero term.

        The last array tells whether a joint moves a keypoint (keypoints, 24).
        """
        there: NDArray[np.bool_] = (self.vectors != 0.0).any(axis=(2, 3))
        keypoint, joint = np.nonzero(there)
        moves = there.copy()
        for below in range(JOINTS - 1, 0, -1):
            moves[:, self.model.parents[below]] |= moves[:, below]
        return keypoint, joint, self.vectors[keypoint, joint], moves

    @cached_property
    def _shaping(self) -> Floats:
        """(72, keypoints x shapes) [m]: a_q by the betas."""
        constants = self.vectors[..., 1 : 1 + self.model.shapes]
        return constants.transpose(1, 2, 0, 3).reshape(3 * JOINTS, -1)

    @cached_property
    def _correctives(self) -> Floats:
        """(72, keypoints x pose features) [m]: a_q by the pose feature."""
        constants = self.vectors[..., 1 + self.model.shapes :]
        return constants.transpose(1, 2, 0, 3).reshape(3 * JOINTS, -1)


def _own_change(local: Floats, turns: Floats, axes: Floats, parents: NDArray[np.int64]) -> Floats:
    """Return the pose feature's derivative by each joint's own angles (n, 23, 9, 3) [1/rad]."""
    # Axes relative to the parent, the frame of the local rotation.
    inward = turns[:, parents[1:]].swapaxes(-1, -2) @ axes[:, 1:]
    changed = np.cross(inward[..., None, :], local[:, 1:, :, :, None], axis=-3)
    return changed.reshape(*inward.shape[:2], 9, 3)


@compile_kernel
def _turn_joints(angles: Floats, parents: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
    """Return rotations of joints relative to parent and world, and axes of their angles.

    Angles (n, joints, 3) [rad] are axis-angle vectors relative to the parents (joints,). Rotations
    are (n, joints, 3, 3), as are axes: column c is the angular velocity in the world while angle c
    grows.
    """
    count, joints = angles.shape[:2]
    local = np.empty((count, joints, 3, 3))
    turns = np.empty((count, joints, 3, 3))
    axes = np.empty((count, joints, 3, 3))
    left = np.empty((3, 3))
    for n in range(count):
        for j in range(joints):
            x, y, z = angles[n, j]
            square = x * x + y * y + z * z
            angle = np.sqrt(square)
            if angle > 0.1:
                first = np.sin(angle) / angle
                third = (1.0 - first) / square
            else:
                # Series exact to double precision.
                first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
                third = (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0
            half = np.sin(0.5 * angle)
            second = 2.0 * half * half / square if angle > 1e-6 else 0.5
            cosine = 1.0 - second * square
            r = angles[n, j]
            for a in range(3):
                for b in range(3):
                    outer = r[a] * r[b]
                    local[n, j, a, b] = second * outer
                    left[a, b] = third * outer
                local[n, j, a, a] += cosine
                left[a, a] += first
            for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                local[n, j, a, b] -= first * r[c]
                local[n, j, b, a] += first * r[c]
                left[a, b] -= second * r[c]
                left[b, a] += second * r[c]
            parent = parents[j]
            for a in range(3):
                for b in range(3):
                    if parent < 0:
                        turns[n, j, a, b] = local[n, j, a, b]
                        axes[n, j, a, b] = left[a, b]
                    else:
                        turned, axis = 0.0, 0.0
                        for c in range(3):
                            turned += turns[n, parent, a, c] * local[n, j, c, b]
                            axis += turns[n, parent, a, c] * left[c, b]
                        turns[n, j, a, b] = turned
                        axes[n, j, a, b] = axis
    return local, turns, axes


@compile_kernel
def _sum_levers(
    turns: Floats,
    axes: Floats,
    terms: Floats,
    keypoint: NDArray[np.int64],
    joint: NDArray[np.int64],
    moves: NDArray[np.bool_],
    parents: NDArray[np.int64],
) -> tuple[Floats, Floats]:
    """Return sums of rotated terms (n, keypoints, 3) [m] and Jacobian (n, keypoints, 3, 72).

    World rotations and axes of the angles are (n, 24, 3, 3), terms (n, terms, 3) [m], unturned. A
    term has a keypoint (terms,), ascending, and a joint (terms,) that rotates it; `moves`
    (keypoints, 24) is whether a joint has any part in a keypoint. Parents are (24,).
    """
    count, joints = turns.shape[:2]
    keypoints = np.zeros((count, len(moves), 3))
    by_pose = np.zeros((count, len(moves), 3, 3 * joints))
    lever = np.empty((joints, 3))
    for n in range(count):
        p = 0
        for k in range(len(moves)):
            lever[:] = 0.0
            while p < len(keypoint) and keypoint[p] == k:
                j = joint[p]
                for a in range(3):
                    for b in range(3):
                        lever[j, a] += turns[n, j, a, b] * terms[n, p, b]
                p += 1
            for j in range(joints - 1, -1, -1):
                if moves[k, j]:
                    if j > 0:
                        for a in range(3):
                            lever[parents[j], a] += lever[j, a]
                    x, y, z = lever[j]
                    for c in range(3):
                        u, v, w = axes[n, j, 0, c], axes[n, j, 1, c], axes[n, j, 2, c]
                        by_pose[n, k, 0, 3 * j + c] = v * z - w * y
                        by_pose[n, k, 1, 3 * j + c] = w * x - u * z
                        by_pose[n, k, 2, 3 * j + c] = u * y - v * x
            keypoints[n, k] = lever[0]
    return keypoints, by_pose
