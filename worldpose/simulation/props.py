"""Objects in an image other than people: goals with their nets, and the ball."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Singles
from worldpose.pitch import PitchTemplate
from worldpose.simulation.mannequins import Surfaces

POST: Final = 0.06
"""Radius of posts and crossbar [m] (Law 1: at most 12 cm across)."""
BALL: Final = 0.11
"""Radius of the ball [m] (Law 2)."""
_THREAD: Final = 0.007
"""Radius of a net's threads, thicker than real ones, which cameras hardly see [m]."""
_MESH: Final = 0.24
"""Distance between threads [m]."""
_PROFILE: Final = np.array([[0.0, 2.44], [1.1, 2.36], [2.0, 0.0]])
"""Profile of the net from the side: depth behind the goal line and height [m]."""
_PIECE: Final = 0.8
"""Longest piece of a thread [m]: long slanting triangles cost time."""


@dataclass(frozen=True, eq=False)
class Prop:
    """An object with one surface.

    Attributes:
        faces: (triangles, 3), counter-clockwise seen from outside.
        backs: (triangles,) which of the two images has their colours.
        texels: (vertices, 2) column and row there.
        picture: (2, rows, columns, 3) RGB.
        surfaces: its position, a batch of 1.
        shadow: whether it casts a shadow.
    """

    faces: NDArray[np.int32]
    backs: NDArray[np.bool_]
    texels: Singles
    picture: NDArray[np.uint8]
    surfaces: Surfaces
    shadow: bool

    def at(self, place: Floats) -> Prop:
        """Return the same shifted by (3,) [m]."""
        vertices = self.surfaces.vertices + place.astype(np.float32)
        return replace(self, surfaces=replace(self.surfaces, vertices=vertices))


def goals(pitch: PitchTemplate) -> tuple[Prop, ...]:
    """Return posts, crossbars and nets of both goals."""
    props: list[Prop] = []
    for side, outward in (("left", -1.0), ("right", 1.0)):
        near, far = f"goal_post_{side}_near", f"goal_post_{side}_far"
        a, b, c, d = pitch.positions(
            (f"{near}_bottom", f"{near}_top", f"{far}_top", f"{far}_bottom")
        )
        props.append(_tubes([(a, b), (b, c), (d, c)], POST, 8, 240, shadow=True))
        props.append(_tubes(_threads(a, d, outward), _THREAD, 3, 225, shadow=False))
    return tuple(props)


def _threads(near: Floats, far: Floats, outward: float) -> list[tuple[Floats, Floats]]:
    """Return the pieces of the threads of a net between two posts' feet."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(_PROFILE, axis=0), axis=1))])
    steps = np.linspace(0.0, along[-1], round(along[-1] / _MESH) + 1)
    depth, height = (np.interp(steps, along, axis) for axis in _PROFILE.T)

    def place(share: float, deep: float, high: float) -> Floats:
        foot = (1.0 - share) * near + share * far
        return np.asarray(foot + np.array([outward * deep, 0.0, high]))

    lines = []
    shares = np.linspace(0.0, 1.0, round(float(np.linalg.norm(far - near)) / _MESH) + 1)
    for deep, high in zip(depth, height, strict=True):
        lines.append((place(0.0, deep, high), place(1.0, deep, high)))
    for share in shares:
        profile = [place(share, *each) for each in zip(depth, height, strict=True)]
        lines += list(itertools.pairwise(profile))
    for share in (0.0, 1.0):
        for deep in np.arange(_MESH, 2.0, _MESH):
            top = float(np.interp(deep, *_PROFILE.T))
            lines.append((place(share, deep, 0.0), place(share, deep, top)))
        for high in np.arange(_MESH, 2.3, _MESH):
            end = float(np.interp(-high, -_PROFILE[1:, 1], _PROFILE[1:, 0]))
            lines.append((place(share, 0.0, high), place(share, end, high)))
    pieces = []
    for a, b in lines:
        count = max(int(np.ceil(np.linalg.norm(b - a) / _PIECE)), 1)
        stops = a + np.linspace(0.0, 1.0, count + 1)[:, None] * (b - a)
        pieces += list(itertools.pairwise(stops))
    return pieces


def _tubes(
    lines: list[tuple[Floats, Floats]], radius: float, corners: int, level: int, *, shadow: bool
) -> Prop:
    """Return one prop of tubes along lines, of one grey level."""
    ends = np.array(lines)
    way = ends[:, 1] - ends[:, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    aside = np.cross(way, np.where(np.abs(way[:, 2:]) > 0.9, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    above = np.cross(way, aside)
    turn = 2.0 * np.pi * np.arange(corners) / corners
    out = np.cos(turn)[:, None] * aside[:, None] + np.sin(turn)[:, None] * above[:, None]
    vertices = ends[:, :, None] + radius * out[:, None]
    normals = np.broadcast_to(out[:, None], vertices.shape)
    k = np.arange(corners)
    n = (k + 1) % corners
    around = np.concatenate(
        [np.stack([k, n, n + corners], axis=1), np.stack([k, n + corners, k + corners], axis=1)]
    )
    faces = around[None] + 2 * corners * np.arange(len(lines))[:, None, None]
    return _prop(
        vertices.reshape(-1, 3), normals.reshape(-1, 3), faces.reshape(-1, 3), level, shadow
    )


def ball() -> Prop:
    """Return the ball, centred at the origin."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    for _ in range(2):
        corners = points[faces]
        middles = [corners[:, k] + corners[:, (k + 1) % 3] for k in range(3)]
        a, b, c = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in middles)
        p, q, r = corners.transpose(1, 0, 2)
        parts = [(p, a, c), (q, b, a), (r, c, b), (a, b, c)]
        points = np.concatenate([np.stack(part, axis=1) for part in parts]).reshape(-1, 3)
        faces = np.arange(len(points)).reshape(-1, 3)
    return _prop(BALL * points, points, faces, 235, shadow=True)


def _prop(
    vertices: Floats, normals: Floats, faces: NDArray[np.int64], level: int, shadow: bool
) -> Prop:
    return Prop(
        faces=faces.astype(np.int32),
        backs=np.zeros(len(faces), dtype=np.bool_),
        texels=np.zeros((len(vertices), 2), dtype=np.float32),
        picture=np.full((2, 1, 1, 3), level, dtype=np.uint8),
        surfaces=Surfaces(vertices[None].astype(np.float32), normals[None].astype(np.float32)),
        shadow=shadow,
    )
