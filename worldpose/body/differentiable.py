"""Body model in torch: the same joints, keypoints and surface, with gradients.

Needs the extra `body`. Other modules of worldpose import this file only on demand.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worldpose.body.keypoints import FoldedKeypoints
from worldpose.body.model import JOINTS


class DifferentiableBody:
    """A body model and its folded keypoints as tensors of one type on one device.

    All methods take `betas` (..., shapes), `global_orient` (..., 3), `body_pose` (..., 69) and
    `transl` (..., 3), whose batch dimensions broadcast, with the meaning they have in
    `BodyParameters`.
    """

    def __init__(
        self,
        keypoints: FoldedKeypoints,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        def tensor(array: NDArray[np.float64]) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        self.model = keypoints.model
        self._parents = self.model.parents.tolist()
        self._identity = torch.eye(3, dtype=dtype, device=device)
        self._joint_template = tensor(self.model.joint_template)
        self._joint_directions = tensor(self.model.joint_directions)
        self._joint = torch.as_tensor(keypoints.joint, device=device)
        self._joint_shares, self._gather = tensor(keypoints.joint_shares), tensor(keypoints.gather)
        self._mass, self._basis = tensor(keypoints.mass)[:, None], tensor(keypoints.basis)
        self._corrected = keypoints.corrected
        self._tensor = tensor

    def joints(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor
    ) -> Tensor:
        """Return the 24 joints (..., 24, 3) [m], world."""
        _, _, joints, _ = self._articulate(betas, global_orient, body_pose)
        return joints + transl[..., None, :]

    def keypoints(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor
    ) -> Tensor:
        """Return the keypoints (..., keypoints, 3) [m], world."""
        local, rotations, joints, offsets = self._articulate(betas, global_orient, body_pose)
        feature = self._feature(betas, local, self._corrected)
        unposed = _split(feature @ self._basis.flatten(0, 1).T, -1, 3)
        parts = (rotations[..., self._joint, :, :] @ unposed[..., None])[..., 0]
        parts = parts + self._mass * offsets[..., self._joint, :]
        return self._joint_shares @ joints + self._gather @ parts + transl[..., None, :]

    def vertices(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor, transl: Tensor
    ) -> Tensor:
        """Return the surface (..., vertices, 3) [m], world."""
        local, rotations, _, offsets = self._articulate(betas, global_orient, body_pose)
        corrected = self.model.pose_directions.shape[-1] > 0
        feature = self._feature(betas, local, corrected)
        unposed = _split(feature @ self._surface_basis.flatten(0, 1).T, -1, 3)
        motions = torch.cat([rotations, offsets[..., None]], dim=-1).flatten(-2)
        blended = _split(self._weights @ motions, 3, 4)
        turned = (blended[..., :3] @ unposed[..., None])[..., 0]
        return turned + blended[..., 3] + transl[..., None, :]

    @cached_property
    def _surface_basis(self) -> Tensor:
        """(vertices, 3, 1 + shapes + pose features) [m]."""
        model = self.model
        parts = [model.template[:, :, None], model.shape_directions, model.pose_directions]
        return self._tensor(np.concatenate(parts, axis=-1))

    @cached_property
    def _weights(self) -> Tensor:
        return self._tensor(self.model.weights)

    def _feature(self, betas: Tensor, local: Tensor, corrected: bool) -> Tensor:
        """Return the linear features of the unposed surface (..., 1 + shapes + pose features)."""
        batch = local.shape[:-3]
        parts = [betas.new_ones((*batch, 1)), betas.expand((*batch, -1))]
        if corrected:
            parts.append((local[..., 1:, :, :] - self._identity).flatten(-3))
        return torch.cat(parts, dim=-1)

    def _articulate(
        self, betas: Tensor, global_orient: Tensor, body_pose: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return local and world rotations, joints and offsets, as in `Articulation`."""
        shaped = self._joint_template + torch.einsum(
            "jcs,...s->...jc", self._joint_directions, betas
        )
        batch = np.broadcast_shapes(
            betas.shape[:-1], global_orient.shape[:-1], body_pose.shape[:-1]
        )
        angles = torch.cat(
            [global_orient.expand((*batch, -1)), body_pose.expand((*batch, -1))], dim=-1
        )
        local = rotation_matrices(_split(angles, JOINTS, 3))
        rest = shaped.expand((*batch, -1, -1))
        rotations, joints = [local[..., 0, :, :]], [rest[..., 0, :]]
        for joint, parent in enumerate(self._parents[1:], start=1):
            bone = (rest[..., joint, :] - rest[..., parent, :])[..., None]
            rotations.append(rotations[parent] @ local[..., joint, :, :])
            joints.append(joints[parent] + (rotations[parent] @ bone)[..., 0])
        turned, placed = torch.stack(rotations, dim=-3), torch.stack(joints, dim=-2)
        return local, turned, placed, placed - (turned @ rest[..., None])[..., 0]


def rotation_matrices(rotvec: Tensor) -> Tensor:
    """Return Rodrigues' rotations (..., 3, 3) of vectors (..., 3) [rad].

    Value and gradient are exact at zero.
    """
    angle = torch.linalg.vector_norm(rotvec, dim=-1)[..., None, None]
    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    cross = _split(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1), 3, 3)
    half = torch.sinc(angle / (2.0 * math.pi))
    outer = rotvec[..., :, None] * rotvec[..., None, :]
    identity = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    turning = torch.cos(angle) * identity + torch.sinc(angle / math.pi) * cross
    return turning + 0.5 * torch.square(half) * outer


def _split(tensor: Tensor, *sizes: int) -> Tensor:
    """Return the tensor with its last dimension split."""
    return tensor.reshape((*tensor.shape[:-1], *sizes))
