"""Pose correctives for the open body: corrections of skinning errors at shoulders and elbows.

The target of every pose is a delta mush of the skinned surface (Mancewicz et al. 2014): smooth it
and the artists' own surface, and add back, rotated with the surface, the detail that smoothing
removed from the latter. That keeps shoulders round and armpits flat where blended transforms pinch
them. Least squares per vertex find the pose-dependent offsets, linear in the joint's rotation
matrix as in SMPL, that bring skinning closest to these targets. Hips and knees have none: a delta
mush takes more volume from a bent leg than skinning does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

MIRROR = np.diag([-1.0, 1.0, 1.0])
STILL = 3e-4
"""Smaller offsets are set to zero [m]."""
GRAIN = 2.0**-12
"""Quantum of offsets [m], so that the file stays small."""
RIDGE = 1e-3
"""Weight of small offsets against accurate ones, for rotations outside the samples [1]."""
OWN = 30
"""Weight of the artists' own pose, which needs no correction, in poses [1]."""


@dataclass(frozen=True)
class Bend:
    """Sampled rotations of a joint of the left arm, and the smoothing of its surface."""

    joint: int
    rounds: int
    """Iterations of smoothing, half way to the neighbours' mean each."""
    rotations: tuple[Array, ...]


def _about(*turns: tuple[str, float]) -> Array:
    """Return the product of rotations about fixed axes, one after the other [degree]."""
    turned = np.eye(3)
    for axis, angle in turns:
        turned = Rotation.from_euler(axis, angle, degrees=True).as_matrix() @ turned
    return turned


BENDS = (
    # Arms from hanging to overhead and from behind to across the chest, twisted.
    Bend(
        16,
        25,
        tuple(
            _about(("x", twist), ("z", raised), ("y", -forward))
            for twist, raised, forward in product(
                (-45, 0, 45), (-85, -50, -20, 0, 30, 60, 80), (-25, 0, 35, 75, 110)
            )
        ),
    ),
    Bend(
        18,
        8,
        tuple(_about(("x", t), ("y", -b)) for t, b in product((-45, 0, 45), range(0, 151, 25))),
    ),
)


def fit_correctives(
    template: Array, joints: Array, weights: Array, faces: NDArray[np.int64], sculpted: Array
) -> tuple[Array, Array]:
    """Return offsets of the template (n, 3) and of each vertex by the pose feature (n, 3, 207) [m].

    Args:
        template: (n, 3), the T-pose that skinning takes to the artists' pose exactly.
        joints: (24, 3).
        weights: (n, 24).
        faces: (triangles, 3).
        sculpted: (24, 3, 3), the joints' rotations in the artists' pose, relative to the parents.
    """
    offsets, directions = np.zeros_like(template), np.zeros((*template.shape, 207))
    neighbours = _neighbours(faces, len(template))
    for joint, rounds, sampled in _both_sides():
        rotations = np.concatenate([sampled, np.repeat(sculpted[joint : joint + 1], OWN, axis=0)])
        share = weights[:, _below(joint)].sum(1)
        pivot = joints[joint]

        def bend(turn: Array, share: Array = share, pivot: Array = pivot) -> Array:
            away = template - pivot
            return template + share[:, None] * (away @ turn.T - away)

        own = bend(sculpted[joint])
        targets = np.stack([_delta_mush(own, bend(turn), neighbours, rounds) for turn in rotations])
        lacking = targets - np.stack([bend(turn) for turn in rotations])
        moved = np.flatnonzero(np.linalg.norm(lacking, axis=-1).max(0) > STILL)
        blended = np.eye(3) + share[moved, None, None] * (rotations[:, None] - np.eye(3))
        feature = np.concatenate(
            [np.ones((len(rotations), 1)), (rotations - np.eye(3)).reshape(-1, 9)], axis=1
        )
        found = _solve_offsets(blended, feature, lacking[:, moved])
        offsets[moved] += found[..., 0]
        directions[moved, :, 9 * (joint - 1) : 9 * joint] += found[..., 1:]
    directions = np.round(directions / GRAIN) * GRAIN
    directions[np.abs(directions).max(axis=(1, 2)) < STILL] = 0.0
    return offsets, directions


def _both_sides() -> Iterator[tuple[int, int, Array]]:
    for bend in BENDS:
        rotations = np.stack(bend.rotations)
        yield bend.joint, bend.rounds, rotations
        yield bend.joint + 1, bend.rounds, MIRROR @ rotations @ MIRROR


def _below(joint: int) -> list[int]:
    """Return the joints of an arm from a shoulder or elbow on."""
    return list(range(joint, 24, 2))


def _solve_offsets(blended: Array, feature: Array, lacking: Array) -> Array:
    """Return offsets (n, 3, 10) by the feature that make skinning reach the target.

    Args:
        blended: (poses, n, 3, 3), blended rotations.
        feature: (poses, 10).
        lacking: (poses, n, 3) [m].
    """
    count = lacking.shape[1]
    squares = np.einsum("pnab,pnac->pnbc", blended, blended)
    pairs = feature[:, :, None] * feature[:, None, :]
    normal = np.tensordot(squares, pairs, axes=(0, 0))  # (n, 3, 3, 10, 10)
    normal = normal.transpose(0, 1, 3, 2, 4).reshape(count, 30, 30)
    right = np.einsum("pnab,pna,pf->nbf", blended, lacking, feature, optimize=True)
    normal += RIDGE * len(feature) * np.eye(30)
    return np.linalg.solve(normal, right.reshape(count, 30, 1)).reshape(count, 3, 10)


def _neighbours(faces: NDArray[np.int64], count: int) -> scipy.sparse.coo_matrix:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    joined = scipy.sparse.csr_matrix((np.ones(len(edges)), edges.T), (count, count))
    joined.data[:] = 1.0
    return joined.tocoo()


def _smooth(points: Array, neighbours: scipy.sparse.coo_matrix, rounds: int) -> Array:
    mean = scipy.sparse.diags(1.0 / np.asarray(neighbours.sum(1)).ravel()) @ neighbours
    for _ in range(rounds):
        points = 0.5 * (points + mean @ points)
    return points


def _delta_mush(
    own: Array, posed: Array, neighbours: scipy.sparse.coo_matrix, rounds: int
) -> Array:
    """Return the delta mush (n, 3) of a posed surface with the details of `own`."""
    start, end = (_smooth(points, neighbours, rounds) for points in (own, posed))
    row, column = neighbours.row, neighbours.col
    products = (end[column] - end[row])[:, :, None] * (start[column] - start[row])[:, None, :]
    moments = np.stack(
        [np.bincount(row, part, minlength=len(own)) for part in products.reshape(-1, 9).T], -1
    )
    left, _, right = np.linalg.svd(moments.reshape(-1, 3, 3))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    moved: Array = end + np.einsum("nab,nb->na", left @ right, own - start)
    return moved
