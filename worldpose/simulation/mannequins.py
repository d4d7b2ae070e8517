"""The open body for rendering: fewer vertices, loose clothes, texture coordinates in kits."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Singles
from worldpose.body import BodyModel, BodyParameters, load_open_body
from worldpose.compiled import compiled

CELL: Final = 0.03
"""Cell size of the vertex clustering [m]: half a pixel to four at 38 to 150 px."""
HAND: Final = 0.76
"""Fingers are beyond that x of the T-pose; they become one mitten [m]."""
TEXEL: Final = 0.0125
"""Texel of a kit's textures [m]: a pixel of a person of 150 px."""
LEFT, TOP, SIZE = -0.96, 0.68, 154
"""Border of a kit's textures [m] and number of texels along each axis."""
WAIST, HEM, SLEEVE = -0.16, -0.53, 0.42
"""Ends of shirt, shorts and sleeves in the T-pose: y, y, and x of both arms [m]."""
KNEE, BOOT, HAIRLINE = -0.70, -1.10, 0.575
"""Upper ends of socks and boots, lower end of the hair in front, y [m]."""


@dataclass(frozen=True, eq=False)
class Mannequin:
    """Common parts of all people, before shape and pose."""

    body: BodyModel
    """The body from which a part of the vertices is kept."""
    kept: NDArray[np.int64]
    """(vertices,) indices of the kept vertices of the body."""
    clothed: Floats
    """(vertices, 3) [m], the mean body in T-pose with the thickness of clothes and hair."""
    outward: Singles
    """(vertices, 3) unit normals of the same."""
    correctives: Singles
    """(207, 3 vertices) [m] for each unit of the pose feature."""
    bones: NDArray[np.int64]
    """(vertices, 4) joints that move each vertex."""
    shares: Singles
    """(vertices, 4) skinning weights of these joints, with sum 1."""
    faces: NDArray[np.int32]
    """(triangles, 3), counter-clockwise seen from outside."""
    backs: NDArray[np.bool_]
    """(triangles,) whether a triangle faces backwards in the T-pose."""
    texels: Singles
    """(vertices, 2) column and row in a kit's textures."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """People's clothed surfaces at one time; those of missing people are NaN."""

    vertices: Singles
    """(persons, vertices, 3) [m], world."""
    normals: Singles
    """(persons, vertices, 3), unit."""

    def toward(self, other: Surfaces, share: float) -> Surfaces:
        """Return positions interpolated by a share towards others, with the present normals."""
        way = np.float32(share) * (other.vertices - self.vertices)
        return Surfaces(self.vertices + way, self.normals)


@functools.cache
def open_mannequin() -> Mannequin:
    """Return the mannequin of the open body."""
    body = load_open_body()
    outward = _normals(body.template, body.faces)
    kept, faces = _clustered(body.template, body.faces)
    template = body.template[kept]
    weights = body.weights[kept]
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    shares = np.take_along_axis(weights, bones, axis=1)
    shares /= shares.sum(axis=1, keepdims=True)
    directions = body.pose_directions[kept].reshape(3 * len(kept), -1)
    a, b, c = (template[faces[:, k]] for k in range(3))
    return Mannequin(
        body=body,
        kept=kept,
        clothed=template + _cloth(template, outward[kept])[:, None] * outward[kept],
        outward=outward[kept].astype(np.float32),
        correctives=np.ascontiguousarray(directions.T, dtype=np.float32),
        bones=bones.astype(np.int64),
        shares=shares.astype(np.float32),
        faces=faces.astype(np.int32),
        backs=np.cross(b - a, c - a)[:, 2] < 0.0,
        texels=((template[:, :2] - [LEFT, TOP]) * [1.0, -1.0] / TEXEL).astype(np.float32),
    )


def shape_people(mannequin: Mannequin, betas: Floats) -> Singles:
    """Return the clothed, unposed surfaces (persons, vertices, 3) [m] of people's betas."""
    directions = mannequin.body.shape_directions[mannequin.kept]
    shaped = mannequin.clothed + np.einsum("vcs,ps->pvc", directions, betas)
    return np.asarray(shaped, dtype=np.float32)


def pose_people(mannequin: Mannequin, shaped: Singles, poses: BodyParameters) -> Surfaces:
    """Return posed surfaces.

    Args:
        mannequin: common model of the people.
        shaped: (persons, vertices, 3) of `shape_people`.
        poses: of the same people, a batch (persons,); NaN = missing.
    """
    posed = mannequin.body.articulate(poses)
    motions = np.concatenate(
        [posed.rotations, (posed.offsets + poses.transl[:, None])[..., None]], axis=-1
    ).astype(np.float32)
    feature = posed.pose_feature[:, : len(mannequin.correctives)].astype(np.float32)
    unposed = shaped + (feature @ mannequin.correctives).reshape(shaped.shape)
    vertices, normals = np.empty_like(shaped), np.empty_like(shaped)
    _skin(
        unposed,
        mannequin.outward,
        motions,
        mannequin.bones,
        mannequin.shares,
        vertices,
        normals,
    )
    return Surfaces(vertices, normals)


def _normals(vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    unit: Floats = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return unit


def _clustered(
    vertices: Floats, faces: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the kept vertices and the faces between them: one per cell, nearest to its mean.

    No cell crosses the middle of the body, so legs stay apart.
    """
    size = np.where(np.abs(vertices[:, :1]) > HAND, 2.0 * CELL, CELL)
    key = np.concatenate([np.floor(vertices / size), size], axis=1)
    _, cell = np.unique(key, axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    mean = np.stack([np.bincount(cell, axis) for axis in vertices.T], axis=1) / count[:, None]
    away = np.linalg.norm(vertices - mean[cell], axis=1)
    order = np.lexsort((away, cell))
    kept = order[np.concatenate([[0], np.cumsum(count)[:-1]])]
    merged = cell[faces]
    a, b, c = merged.T
    return kept, merged[(a != b) & (b != c) & (c != a)]


def _cloth(template: Floats, outward: Floats) -> Floats:
    """Return the thickness of clothes and hair over the skin (vertices,) [m]."""
    x, y, z = np.abs(template[:, 0]), template[:, 1], template[:, 2]
    off = np.zeros(len(template))
    trunk = (y > WAIST - 0.02) & (y < 0.32) & (x < SLEEVE)
    # Sleeves and shorts widen towards their hems.
    off[trunk] = 0.012 + 0.02 * np.clip((x[trunk] - 0.2) / (SLEEVE - 0.2), 0.0, 1.0)
    off[trunk & (x < 0.2)] += 0.012 * np.clip((0.1 - y[trunk & (x < 0.2)]) / 0.2, 0.0, 1.0)
    legs = (y <= WAIST - 0.02) & (y > HEM)
    off[legs] = 0.018 + 0.03 * (WAIST - y[legs]) / (WAIST - HEM)
    # Clothes are thin at the inside of the thighs.
    off[legs] *= np.clip(0.5 + outward[legs, 0] * np.sign(template[legs, 0]), 0.2, 1.0)
    off[(y < KNEE) & (y > BOOT)] = 0.006
    off[y <= BOOT] = 0.008
    hair = (y > HAIRLINE) | ((y > 0.45) & (z < 0.04))
    off[hair] = 0.016
    return off


@compiled
def _skin(
    shaped: Singles,
    outward: Singles,
    motions: Singles,
    bones: NDArray[np.int64],
    shares: Singles,
    vertices: Singles,
    normals: Singles,
) -> None:
    """Write surfaces and their normals, each vertex moved by the blend of its joints' motions."""
    blend = np.empty((3, 4), dtype=np.float32)
    for p in range(shaped.shape[0]):
        for v in range(shaped.shape[1]):
            blend[:] = 0.0
            for k in range(bones.shape[1]):
                share = shares[v, k]
                if share > 0.0:
                    for i in range(3):
                        for j in range(4):
                            blend[i, j] += share * motions[p, bones[v, k], i, j]
            for i in range(3):
                vertices[p, v, i] = (
                    blend[i, 0] * shaped[p, v, 0]
                    + blend[i, 1] * shaped[p, v, 1]
                    + blend[i, 2] * shaped[p, v, 2]
                    + blend[i, 3]
                )
                normals[p, v, i] = (
                    blend[i, 0] * outward[v, 0]
                    + blend[i, 1] * outward[v, 1]
                    + blend[i, 2] * outward[v, 2]
                )
            n = normals[p, v]
            length = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            for i in range(3):
                normals[p, v, i] /= max(length, np.float32(1e-6))
