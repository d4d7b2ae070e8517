"""The people and things of a film: clothes, shape and pose of each; goals and the ball."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Singles
from worldpose.body.model import BodyParameters
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.mannequins import (
    Kit,
    Mannequin,
    Role,
    Surfaces,
    draw_kits,
    open_mannequin,
    paint_person,
    pose_people,
    shape_people,
)
from worldpose.simulation.settings import PATTERNS, CrowdSettings, Pattern
from worldpose.simulation.skeletons import draw_figure

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
        texels: (vertices, 2) column and row in the image.
        image: (2, rows, columns, 3) RGB.
        surfaces: its position, a batch of 1.
        shadow: whether it casts a shadow.
    """

    faces: NDArray[np.int32]
    backs: NDArray[np.bool_]
    texels: Singles
    image: NDArray[np.uint8]
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
        props.append(_make_tubes([(a, b), (b, c), (d, c)], POST, 8, 240, shadow=True))
        props.append(_make_tubes(_net_threads(a, d, outward), _THREAD, 3, 225, shadow=False))
    return tuple(props)


def _net_threads(near: Floats, far: Floats, outward: float) -> list[tuple[Floats, Floats]]:
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
        profile = [place(share, deep, high) for deep, high in zip(depth, height, strict=True)]
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


def _make_tubes(
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
    return _make_prop(
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
    return _make_prop(BALL * points, points, faces, 235, shadow=True)


def _make_prop(
    vertices: Floats, normals: Floats, faces: NDArray[np.int64], level: int, shadow: bool
) -> Prop:
    return Prop(
        faces=faces.astype(np.int32),
        backs=np.zeros(len(faces), dtype=np.bool_),
        texels=np.zeros((len(vertices), 2), dtype=np.float32),
        image=np.full((2, 1, 1, 3), level, dtype=np.uint8),
        surfaces=Surfaces(vertices[None].astype(np.float32), normals[None].astype(np.float32)),
        shadow=shadow,
    )


BEHIND: Final = (2.5, 3.3)
"""Distance of bystanders behind the lines and before the boards [m]."""


@dataclass(frozen=True, eq=False)
class Cast:
    """Dressed people before they are posed.

    Attributes:
        mannequin: common model of all people.
        shaped: (persons, vertices, 3) [m], clothed and unposed.
        images: (persons, 2, rows, columns, 3) RGB, kits from the front and the back.
    """

    mannequin: Mannequin
    shaped: NDArray[np.float32]
    images: NDArray[np.uint8]

    def pose(self, poses: BodyParameters) -> Surfaces:
        """Return their surfaces in the poses (persons,) at one time; NaN = missing."""
        return pose_people(self.mannequin, self.shaped, poses)


def dress_people(
    betas: NDArray[np.float64],
    roles: Sequence[Role],
    seed: int,
    patterns: tuple[Pattern, ...] = PATTERNS,
) -> Cast:
    """Return a cast; a person's looks depend on the seed and the person's number alone.

    Args:
        betas: (persons, 10) betas of the open body.
        roles: role of each person.
        seed: draws kits and looks.
        patterns: shirt patterns to draw from.
    """
    mannequin = open_mannequin()
    kits = draw_kits(np.random.default_rng([seed, 5]), patterns)
    numbers: dict[Role, int] = {"first keeper": 0, "second keeper": 0}
    images = []
    for person, role in enumerate(roles):
        numbers[role] = numbers.get(role, 1) + 1
        number = None if role == "official" else numbers[role]
        rng = np.random.default_rng([seed, 6, person])
        images.append(paint_person(kits[role], number, rng))
    shape = (len(roles), *(images[0].shape if images else (2, 1, 1, 3)))
    return Cast(
        mannequin,
        shape_people(mannequin, betas),
        np.array(images, dtype=np.uint8).reshape(shape),
    )


def place_bystanders(pitch: PitchTemplate, count: int, seed: int) -> tuple[Prop, ...]:
    """Return bystanders who stand off the pitch and watch."""
    rng = np.random.default_rng([seed, 8])
    along, side = rng.uniform(-0.9, 0.9, count), rng.integers(4, size=count)
    behind = rng.uniform(BEHIND[0], BEHIND[1], count)
    half = 0.5 * np.array([pitch.length, pitch.width])
    props = []
    for share, which, off in zip(along, side, behind, strict=True):
        axis, toward = divmod(int(which), 2)
        place = np.empty(2)
        place[1 - axis], place[axis] = share * half[1 - axis], (2 * toward - 1) * (half[axis] + off)
        betas = draw_figure((1.55, 1.9), rng).betas
        bib = _plain_kit(rng.uniform(0.1, 0.9, 3), rng)
        props.append(_make_bystander(betas, place, pitch, paint_person(bib, None, rng), rng))
    return tuple(props)


def _plain_kit(color: NDArray[np.float64], rng: np.random.Generator) -> Kit:
    dark = rng.uniform(0.05, 0.3, 3)
    return Kit(color, 0.8 * color, "plain", dark, dark, dark, float(rng.choice([0.42, 0.74])))


def _make_bystander(
    betas: NDArray[np.float64],
    place: NDArray[np.float64],
    pitch: PitchTemplate,
    image: NDArray[np.uint8],
    rng: np.random.Generator,
) -> Prop:
    """Return a person with hanging arms on the grass who faces the middle of the pitch."""
    mannequin = open_mannequin()
    course = np.arctan2(-place[1], -place[0]) + rng.normal(0.0, 0.5)
    upright = Rigid.from_rotvec(np.array([0.5 * np.pi, 0.0, 0.0]), np.zeros(3)).rotation
    # The upright model faces -y.
    turned = Rigid.from_rotvec(np.array([0.0, 0.0, course + 0.5 * np.pi]), np.zeros(3)).rotation
    pose = np.zeros((23, 3))
    pose[15, 2], pose[16, 2] = -rng.uniform(1.0, 1.3), rng.uniform(1.0, 1.3)
    poses = BodyParameters(
        betas[None],
        Rigid(turned @ upright, np.zeros(3)).rotvec[None],
        pose.reshape(1, 69),
        np.array([[*place, float(pitch.height(place[0], place[1]))]]),
    )
    surfaces = pose_people(mannequin, shape_people(mannequin, betas[None]), poses)
    sole = surfaces.vertices[0, :, 2].min() - poses.transl[0, 2]
    standing = Surfaces(
        surfaces.vertices - np.array([0.0, 0.0, sole], dtype=np.float32), surfaces.normals
    )
    return Prop(mannequin.faces, mannequin.backs, mannequin.texels, image, standing, shadow=True)


def assign_roles(crowd: CrowdSettings, persons: int) -> list[Role]:
    """Return everyone's role, in the order of `worldpose.simulation.football` and `contests`."""
    roles: list[Role] = ["first" if person % 2 == 0 else "second" for person in range(persons)]
    if crowd.movement == "football":
        keepers: list[Role] = ["first keeper", "second keeper"]
        roles[:2] = keepers[: min(2, persons)]
        for official in range(max(persons - crowd.officials, 0), persons):
            roles[official] = "official"
    elif crowd.movement == "corner" and persons:
        roles[-1] = "second keeper"
    return roles
