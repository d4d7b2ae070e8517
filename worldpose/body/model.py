"""Body model: a surface and 24 joints, shaped by betas and posed by joint angles.

Loper et al., "SMPL: A Skinned Multi-Person Linear Model" (2015), describes the function; any model
in that layout can be loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.geometry.rigid import Index, Rigid, check_shape, common_batch, index_leading

BODY_POSE = 69
"""Length of `body_pose`: three angles for each of the 23 joints below the pelvis."""


@dataclass(frozen=True, eq=False)
class BodyParameters:
    """One body or a batch of them; batch dimensions broadcast against each other, or InputError.

    Rotations are axis-angle vectors relative to the parent joint. `global_orient` rotates the body
    about its pelvis joint, and `transl` is added after that: the pelvis of a body stands at
    `transl` plus the pelvis of its unposed shape.
    """

    betas: NDArray[np.float64]
    """(..., shapes), comparable only within one body model."""
    global_orient: NDArray[np.float64]
    """(..., 3) [rad], world."""
    body_pose: NDArray[np.float64]
    """(..., 69) [rad]."""
    transl: NDArray[np.float64]
    """(..., 3) [m], world."""

    def __post_init__(self) -> None:
        lengths = {"betas": -1, "global_orient": 3, "body_pose": BODY_POSE, "transl": 3}
        arrays = {
            name: check_shape(f"BodyParameters.{name}", getattr(self, name), (length,))
            for name, length in lengths.items()
        }
        batch = common_batch("BodyParameters", *(array.shape[:-1] for array in arrays.values()))
        for name, array in arrays.items():
            object.__setattr__(self, name, np.broadcast_to(array, (*batch, array.shape[-1])))

    @classmethod
    def rest(cls, shapes: int = 10) -> BodyParameters:
        """Return the mean body in T-pose, upright along +y."""
        return cls(np.zeros(shapes), np.zeros(3), np.zeros(BODY_POSE), np.zeros(3))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the batch; () for a single body."""
        return self.transl.shape[:-1]

    @property
    def known(self) -> NDArray[np.bool_]:
        """(...), bodies without a missing value."""
        finite = [np.isfinite(array).all(axis=-1) for array in self._arrays()]
        return np.asarray(np.all(finite, axis=0), dtype=np.bool_)

    def __getitem__(self, index: Index) -> BodyParameters:
        return BodyParameters(*(array[index_leading(index, 1)] for array in self._arrays()))

    def flat(self) -> BodyParameters:
        """Return the same bodies in one batch dimension."""
        return BodyParameters(*(array.reshape(-1, array.shape[-1]) for array in self._arrays()))

    def _arrays(self) -> tuple[NDArray[np.float64], ...]:
        return self.betas, self.global_orient, self.body_pose, self.transl


JOINTS: Final = 24
SMPL_VERTICES: Final = 6890
"""Vertices of every model in SMPL's layout; only there do vertex numbers have a meaning."""
POSE_FEATURES: Final = 9 * (JOINTS - 1)
"""Length of the pose feature: the 23 rotation matrices minus the identity."""


@dataclass(frozen=True, eq=False)
class Articulation:
    """Posed frames of the joints, before the body's translation.

    A point `x` fixed to joint j of the unposed body goes to `rotations[j] x + offsets[j]`.
    """

    local_rotations: NDArray[np.float64]
    """(..., joints, 3, 3), relative to the parent."""
    rotations: NDArray[np.float64]
    """(..., joints, 3, 3), relative to the world."""
    joints: NDArray[np.float64]
    """(..., joints, 3) [m]."""
    offsets: NDArray[np.float64]
    """(..., joints, 3) [m]."""

    @property
    def pose_feature(self) -> NDArray[np.float64]:
        """Rotations of all joints but the first minus the identity (..., 9 (joints - 1))."""
        away = self.local_rotations[..., 1:, :, :] - np.eye(3)
        return away.reshape(*away.shape[:-3], 9 * away.shape[-3])


def articulate(
    rest: NDArray[np.float64], local_rotations: NDArray[np.float64], parents: NDArray[np.int64]
) -> Articulation:
    """Return the frames of the joints (..., joints, 3) [m] of an unposed kinematic tree.

    `local_rotations` (..., joints, 3, 3) are relative to the parents (joints,), each smaller than
    its joint, -1 for the root, which stays in place.
    """
    rotations, joints = local_rotations.copy(), rest.copy()
    for joint, parent in enumerate(parents[1:], start=1):
        bone = (rest[..., joint, :] - rest[..., parent, :])[..., None]
        turning = rotations[..., parent, :, :]
        rotations[..., joint, :, :] = turning @ local_rotations[..., joint, :, :]
        joints[..., joint, :] = joints[..., parent, :] + (turning @ bone)[..., 0]
    offsets = joints - (rotations @ rest[..., None])[..., 0]
    return Articulation(local_rotations, rotations, joints, offsets)


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body in the layout of SMPL; InputError if its arrays are no body model's."""

    name: str
    """Name and version that results carry, such as `open-neutral/2`."""
    template: NDArray[np.float64]
    """(vertices, 3) [m], the mean body in T-pose: y up, facing +z, left arm along +x."""
    shape_directions: NDArray[np.float64]
    """(vertices, 3, shapes) [m] for each unit of the betas."""
    pose_directions: NDArray[np.float64]
    """(vertices, 3, 207) [m] for each unit of the pose feature, or (vertices, 3, 0) for none."""
    joint_regressor: NDArray[np.float64]
    """(24, vertices), rows with sum 1."""
    weights: NDArray[np.float64]
    """(vertices, 24), the share of each joint in each vertex, rows with sum 1."""
    parents: NDArray[np.int64]
    """(24,), each smaller than its joint; -1 for the pelvis."""
    faces: NDArray[np.int64]
    """(triangles, 3) indices of vertices, counter-clockwise seen from outside."""

    def __post_init__(self) -> None:
        floats = ("template", "shape_directions", "pose_directions", "joint_regressor", "weights")
        for name in floats:
            # Files have either memory order, and the last bits of sums depend on it.
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, array)
        for name in ("parents", "faces"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.int64))
        count = self.template.shape[0] if self.template.ndim else 0
        features = POSE_FEATURES if self.pose_directions.shape[-1:] != (0,) else 0
        shapes = {
            "template": (count, 3),
            "shape_directions": (count, 3, self.shape_directions.shape[-1]),
            "pose_directions": (count, 3, features),
            "joint_regressor": (JOINTS, count),
            "weights": (count, JOINTS),
            "parents": (JOINTS,),
            "faces": (self.faces.shape[0], 3),
        }
        for name, shape in shapes.items():
            self._require(getattr(self, name).shape == shape, name, f"shape {shape}")
        for name in floats:
            self._require(bool(np.isfinite(getattr(self, name)).all()), name, "finite numbers")
        # Files in single precision sum to 1 within the rounding of some thousand additions.
        for name in ("joint_regressor", "weights"):
            sums = getattr(self, name).sum(-1)
            self._require(bool(np.allclose(sums, 1.0, atol=1e-3)), name, "rows with sum 1")
        chain = (self.parents[0] == -1) & (self.parents[1:] >= 0).all()
        chain &= (self.parents < np.arange(JOINTS)).all()
        self._require(bool(chain), "parents", "-1 first, then parents before their children")
        inside = ((self.faces >= 0) & (self.faces < count)).all()
        self._require(bool(inside), "faces", f"indices below {count}")

    def _require(self, holds: bool, name: str, expected: str) -> None:
        if not holds:
            array = getattr(self, name)
            raise InputError(
                f"body model {self.name}: {name}",
                expected=expected,
                found=f"shape {array.shape}" if expected.startswith("shape") else "others",
                todo="Give the file of a body model with SMPL's 24 joints.",
            )

    @property
    def shapes(self) -> int:
        """Number of betas."""
        return int(self.shape_directions.shape[-1])

    @cached_property
    def joint_template(self) -> NDArray[np.float64]:
        """The joints of the mean body in T-pose (24, 3) [m]."""
        return self.joint_regressor @ self.template

    @cached_property
    def joint_directions(self) -> NDArray[np.float64]:
        """Motion of the joints per unit of the betas (24, 3, shapes) [m]."""
        moved: NDArray[np.float64] = np.einsum(
            "jv,vcs->jcs", self.joint_regressor, self.shape_directions, optimize=True
        )
        return moved

    def articulate(self, parameters: BodyParameters) -> Articulation:
        """Return the posed frame of every joint, before `transl`; InputError for other betas."""
        if parameters.betas.shape[-1] != self.shapes:
            raise InputError(
                "BodyParameters.betas",
                expected=f"{self.shapes} betas of {self.name}",
                found=str(parameters.betas.shape[-1]),
                todo="Betas belong to one body model; fit them again for another.",
            )
        angles = np.concatenate([parameters.global_orient, parameters.body_pose], axis=-1)
        rotvecs = angles.reshape(*parameters.batch_shape, JOINTS, BODY_POSE // (JOINTS - 1))
        rest = self.joint_template + np.einsum(
            "jcs,...s->...jc", self.joint_directions, parameters.betas
        )
        return articulate(rest, Rigid.from_rotvec(rotvecs, np.zeros(3)).rotation, self.parents)

    def joints(self, parameters: BodyParameters) -> NDArray[np.float64]:
        """Return the 24 joints (..., 24, 3) [m], world; NaN where a parameter is."""
        return self.articulate(parameters).joints + parameters.transl[..., None, :]

    def vertices(self, parameters: BodyParameters) -> NDArray[np.float64]:
        """Return the surface (..., vertices, 3) [m], world; NaN where a parameter is."""
        flat = parameters.flat()
        count = len(self.template)
        surfaces = np.empty((*flat.batch_shape, count, 3))
        # Bodies whose surfaces are computed at a time; 24 MB of transforms in SMPL's layout.
        bodies_at_once = 32
        for start in range(0, len(surfaces), bodies_at_once):
            chunk = slice(start, start + bodies_at_once)
            surfaces[chunk] = self._surface(flat[chunk])
        return surfaces.reshape(*parameters.batch_shape, count, 3)

    def _surface(self, parameters: BodyParameters) -> NDArray[np.float64]:
        """Return the surfaces (n, vertices, 3) of a flat batch."""
        posed = self.articulate(parameters)
        unposed = self.template + np.einsum(
            "vcs,ns->nvc", self.shape_directions, parameters.betas, optimize=True
        )
        if self.pose_directions.shape[-1]:
            unposed += np.einsum(
                "vcp,np->nvc", self.pose_directions, posed.pose_feature, optimize=True
            )
        motions = np.concatenate([posed.rotations, posed.offsets[..., None]], axis=-1)
        blended = (self.weights @ motions.reshape(-1, JOINTS, 12)).reshape(*unposed.shape, 4)
        turned = np.einsum("nvab,nvb->nva", blended[..., :3], unposed)
        surface: NDArray[np.float64] = turned + blended[..., 3] + parameters.transl[:, None]
        return surface


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the unit normals (vertices, 3) of a surface, by the areas of the faces around."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: NDArray[np.float64] = normals / np.maximum(length, 1e-12)
    return unit


def cluster_vertices(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], keys: NDArray[Any]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return a vertex for each cell, `keys` (vertices, k), nearest to its mean, and the faces."""
    _, cell = np.unique(keys, axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, axis) for axis in vertices.T], axis=1) / count[:, None]
    order = np.lexsort((np.linalg.norm(vertices - mean[cell], axis=1), cell))
    kept = order[np.cumsum(count) - count]
    merged = cell[faces]
    a, b, c = merged.T
    return kept, merged[(a != b) & (b != c) & (c != a)]
