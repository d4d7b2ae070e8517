"""The open body for rendering: fewer vertices, loose clothes, and textures of kits."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, Image, Integers, Singles
from worldpose.body.body_file import load_open_body
from worldpose.body.model import BodyModel, BodyParameters, cluster_vertices, vertex_normals
from worldpose.simulation.settings import PATTERNS, CrowdSettings, Pattern

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
    kept: Integers
    """(vertices,) indices of the kept vertices of the body."""
    clothed: Floats
    """(vertices, 3) [m], the mean body in T-pose with the thickness of clothes and hair."""
    outward: Singles
    """(vertices, 3) unit normals of the same."""
    correctives: Singles
    """(207, 3 vertices) [m] for each unit of the pose feature."""
    bones: Integers
    """(vertices, 4) joints that move each vertex."""
    shares: Singles
    """(vertices, 4) skinning weights of these joints, with sum 1."""
    faces: NDArray[np.int32]
    """(triangles, 3), counter-clockwise seen from outside."""
    backs: Flags
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
    outward = vertex_normals(body.template, body.faces)
    hand = 0.76  # fingers are beyond that x of the T-pose; they become one mitten [m]
    # Cell size of the vertex clustering [m]: half a pixel to four at 38 to 150 px. No cell crosses
    # the middle of the body, so legs stay apart.
    size = np.where(np.abs(body.template[:, :1]) > hand, 0.06, 0.03)
    keys = np.concatenate([np.floor(body.template / size), size], axis=1)
    kept, faces = cluster_vertices(body.template, body.faces, keys)
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
        clothed=template + _cloth_thickness(template, outward[kept])[:, None] * outward[kept],
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
    """Return posed surfaces of `shape_people`'s (persons, vertices, 3) [m]; NaN where a pose is."""
    posed = mannequin.body.articulate(poses)
    motions = np.concatenate(
        [posed.rotations, (posed.offsets + poses.transl[:, None])[..., None]], axis=-1
    ).astype(np.float32)
    feature = posed.pose_feature[:, : len(mannequin.correctives)].astype(np.float32)
    unposed = shaped + (feature @ mannequin.correctives).reshape(shaped.shape)
    blend = np.zeros((*shaped.shape, 4), dtype=np.float32)
    for bones, shares in zip(mannequin.bones.T, mannequin.shares.T, strict=True):
        blend += shares[:, None, None] * motions[:, bones]
    vertices = np.einsum("pvij,pvj->pvi", blend[..., :3], unposed) + blend[..., 3]
    normals = np.einsum("pvij,vj->pvi", blend[..., :3], mannequin.outward)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return Surfaces(vertices, normals / np.maximum(length, np.float32(1e-6)))


def _cloth_thickness(template: Floats, outward: Floats) -> Floats:
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


Role = Literal["first", "second", "first keeper", "second keeper", "official"]
_CLOTH: Final = np.array(
    [
        *([0.76, 0.07, 0.10], [0.90, 0.91, 0.93], [0.10, 0.22, 0.58], [0.42, 0.66, 0.88]),
        *([0.07, 0.07, 0.08], [0.93, 0.78, 0.12], [0.08, 0.42, 0.24], [0.45, 0.07, 0.16]),
        *([0.93, 0.45, 0.08], [0.33, 0.16, 0.48], [0.06, 0.10, 0.25], [0.10, 0.55, 0.58]),
    ]
)
_BRIGHT: Final = np.array(
    [[0.80, 0.95, 0.15], [0.97, 0.42, 0.60], [0.15, 0.80, 0.45], [0.98, 0.60, 0.10]]
)
"""Colors of the shirts of goalkeepers and officials."""
_LIGHT, _DARK = np.array([0.90, 0.69, 0.56]), np.array([0.24, 0.14, 0.095])
_HAIR: Final = np.array(
    [[0.05, 0.04, 0.035], [0.14, 0.09, 0.06], [0.28, 0.18, 0.10], [0.62, 0.48, 0.26]]
)


@dataclass(frozen=True, eq=False)
class Kit:
    """Clothes of the people of one role; colours (3,) RGB in [0, 1]."""

    shirt: Floats
    second: Floats
    pattern: Pattern
    shorts: Floats
    socks: Floats
    tops: Floats
    """Color of the upper ends of the socks."""
    sleeve: float
    """End of the sleeves in the T-pose, x of both arms [m]."""
    gloves: bool = False


def draw_kits(
    rng: np.random.Generator, patterns: tuple[Pattern, ...] = PATTERNS
) -> dict[Role, Kit]:
    """Return the kits of a match: two distinguishable teams, keepers and officials."""
    first = _team_kit(rng, patterns, None)
    second = _team_kit(rng, patterns, first)
    order = rng.permutation(len(_BRIGHT))
    keepers = [_keeper_kit(_jitter_color(_BRIGHT[k], rng), rng) for k in order[:2]]
    black = np.array([0.06, 0.06, 0.07])
    shirt = _jitter_color(black if rng.random() < 0.5 else _BRIGHT[order[2]], rng)
    official = Kit(shirt, black, "plain", black, black, black, SLEEVE)
    return {
        "first": first,
        "second": second,
        "first keeper": keepers[0],
        "second keeper": keepers[1],
        "official": official,
    }


def _team_kit(rng: np.random.Generator, patterns: tuple[Pattern, ...], other: Kit | None) -> Kit:
    away = np.zeros(len(_CLOTH)) if other is None else np.linalg.norm(_CLOTH - other.shirt, axis=1)
    # Far from the other team's colours.
    allowed = np.flatnonzero(away > 0.55) if other is not None else np.arange(len(_CLOTH))
    shirt = _CLOTH[rng.choice(allowed)]
    contrast = np.flatnonzero(np.linalg.norm(_CLOTH - shirt, axis=1) > 0.5)
    second = _CLOTH[rng.choice(contrast)]
    shorts = (shirt, second, _CLOTH[1], _CLOTH[4])[int(rng.choice(4, p=[0.35, 0.3, 0.2, 0.15]))]
    socks = shirt if rng.random() < 0.6 else second
    pattern = patterns[int(rng.integers(len(patterns)))]
    return Kit(
        _jitter_color(shirt, rng),
        _jitter_color(second, rng),
        pattern,
        _jitter_color(shorts, rng),
        _jitter_color(socks, rng),
        second,
        SLEEVE,
    )


def _keeper_kit(shirt: Floats, rng: np.random.Generator) -> Kit:
    shorts = shirt if rng.random() < 0.5 else _CLOTH[4]
    return Kit(shirt, 0.7 * shirt, "sleeves", shorts, shirt, shorts, 0.74, gloves=True)


def _jitter_color(color: Floats, rng: np.random.Generator) -> Floats:
    return np.clip(color + rng.normal(0.0, 0.025, 3), 0.02, 0.97)


def paint_person(kit: Kit, number: int | None, rng: np.random.Generator) -> Image:
    """Return the textures (2, SIZE, SIZE, 3) of one person's front and back, in the T-pose.

    `rng` draws skin, hair, boots and the folds of the cloth.
    """
    x = LEFT + TEXEL * (np.arange(SIZE) + 0.5)
    y = TOP - TEXEL * (np.arange(SIZE) + 0.5)
    x, y = np.meshgrid(x, y)
    tone = rng.beta(1.1, 0.9)
    skin = (1.0 - tone) * _DARK + tone * _LIGHT
    shade = _HAIR[0] if tone < 0.35 else _HAIR[int(rng.choice(4, p=[0.35, 0.35, 0.2, 0.1]))]
    style, bearded = rng.random(), rng.random() < 0.4
    boots = _CLOTH[4] if rng.random() < 0.4 else _jitter_color(_BRIGHT[rng.integers(4)], rng)
    sides = np.empty((2, SIZE, SIZE, 3))
    for side, image in enumerate(sides):
        image[:] = skin
        _paint_head(image, x, y, skin, shade, style, bearded=bearded, front=side == 0)
        # Cloth is cast in folds.
        folds = _folds(rng)[..., None]
        shirt = (y > WAIST) & (y < 0.335) & (np.abs(x) < kit.sleeve)
        # A neck, lower in front.
        shirt &= ~((np.abs(x) < 0.075) & (y > (0.285 if side == 0 else 0.32)))
        cloth = _paint_shirt(kit, x, y)
        if number is not None:
            _print_number(cloth, kit, number, back=side == 1)
        image[shirt] = (cloth * folds)[shirt]
        shorts = (y <= WAIST) & (y > HEM)
        stripe = np.abs(np.abs(x) - 0.185) < 0.015
        image[shorts] = (kit.shorts * folds)[shorts]
        image[shorts & stripe] = kit.second
        socks = (y <= KNEE) & (y > BOOT)
        image[socks] = (kit.socks * (0.5 + 0.5 * folds))[socks]
        image[socks & (y > KNEE - 0.05)] = kit.tops
        image[y <= BOOT] = boots
        image[y <= -1.185] = 0.75 * boots
        if kit.gloves:
            image[np.abs(x) > 0.74] = kit.second
    return np.asarray(np.clip(np.rint(255.0 * sides), 0.0, 255.0), dtype=np.uint8)


def _paint_head(
    image: Floats,
    x: Floats,
    y: Floats,
    skin: Floats,
    hair: Floats,
    style: float,
    *,
    bearded: bool,
    front: bool,
) -> None:
    """Paint face and hair; a tenth of the people are bald."""
    covered = y > 0.435
    if front:
        face = ((x / 0.074) ** 2 + ((y - 0.49) / 0.092) ** 2) < 1.0
        covered = (y > HAIRLINE) | ((y > 0.47) & ~face)
        for side in (-1.0, 1.0):
            eye = ((x - side * 0.031) / 0.017) ** 2 + ((y - 0.516) / 0.011) ** 2 < 1.0
            image[eye] = 0.35 * skin
            brow = (np.abs(x - side * 0.032) < 0.02) & (np.abs(y - 0.538) < 0.007)
            image[brow] = 0.5 * skin
        mouth = (np.abs(x) < 0.024) & (np.abs(y - 0.434) < 0.007)
        image[mouth] = skin * [0.75, 0.55, 0.55]
        if bearded and style > 0.1:
            chin = (y < 0.45) & (y > 0.385) & (np.abs(x) < 0.075) & ~mouth
            image[chin] = 0.45 * skin + 0.55 * hair
    if style > 0.1:
        image[covered] = hair


def _paint_shirt(kit: Kit, x: Floats, y: Floats) -> Floats:
    """Return the shirt's colours (SIZE, SIZE, 3) without number and folds."""
    ahead = np.abs(x) < 0.20
    chosen = {
        "plain": np.zeros(x.shape, dtype=bool),
        "sleeves": np.abs(x) > 0.19,
        "stripes": ((x / 0.08 + 0.5) % 2.0 < 1.0) & ahead,
        "hoops": ((y / 0.09 + 0.5) % 2.0 < 1.0) & ahead,
        "band": (np.abs(y - 0.13) < 0.05) & ahead,
        "halves": x > 0.0,
        "sash": (np.abs(y - 0.08 - 0.9 * x) < 0.06) & ahead,
        "chequers": ((x / 0.1 + 0.5) % 2.0 < 1.0) ^ ((y / 0.1 + 0.5) % 2.0 < 1.0),
    }[kit.pattern]
    cloth = np.where(chosen[..., None], kit.second, kit.shirt)
    trim = (np.abs(np.abs(x) - kit.sleeve) < 0.02) | (np.abs(y - WAIST) < 0.012)
    cloth[trim] = kit.second
    return cloth


def _print_number(cloth: Floats, kit: Kit, number: int, *, back: bool) -> None:
    """Print a number of 22 cm on the back, or one of 9 cm on the chest."""
    mean = 0.5 * (kit.shirt + kit.second) if kit.pattern != "plain" else kit.shirt
    color = np.full(3, 0.95) if mean.mean() < 0.5 else np.full(3, 0.05)
    text, face = str(number), cv2.FONT_HERSHEY_SIMPLEX
    tall, thick = (0.21, 3) if back else (0.08, 1)
    scale = tall / TEXEL / 21.0
    (wide, high), _ = cv2.getTextSize(text, face, scale, thick)
    mask = np.zeros((SIZE, SIZE), dtype=np.uint8)
    middle, row = round(-LEFT / TEXEL), round((TOP - (0.13 if back else 0.19)) / TEXEL)
    where = (middle - wide // 2 - (0 if back else 5), row + high // 2)
    cv2.putText(mask, text, where, face, scale, 255, thick)
    # Seen from behind, left is right.
    cloth[(mask[:, ::-1] if back else mask) > 0] = color


def _folds(rng: np.random.Generator) -> Floats:
    """Return the brightness of creased cloth (SIZE, SIZE), about 1."""
    grain = rng.standard_normal((SIZE, SIZE))
    broad = cv2.GaussianBlur(grain, (0, 0), 5.0)
    creases = cv2.GaussianBlur(grain, (0, 0), 1.5)
    return np.asarray(1.0 + 0.09 * broad / broad.std() + 0.05 * creases / creases.std())


@dataclass(frozen=True, eq=False)
class Cast:
    """Dressed people before they are posed.

    Attributes:
        mannequin: common model of all people.
        shaped: (persons, vertices, 3) [m], clothed and unposed.
        images: (persons, 2, rows, columns, 3) RGB, kits from the front and the back.
    """

    mannequin: Mannequin
    shaped: Singles
    images: Image

    def pose(self, poses: BodyParameters) -> Surfaces:
        """Return their surfaces in the poses (persons,) at one time; NaN = missing."""
        return pose_people(self.mannequin, self.shaped, poses)


def dress_people(
    betas: Floats, roles: Sequence[Role], seed: int, patterns: tuple[Pattern, ...] = PATTERNS
) -> Cast:
    """Return a cast; a person's looks depend on the seed and the person's number alone.

    `betas` (persons, 10) are of the open body.
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
        mannequin, shape_people(mannequin, betas), np.array(images, dtype=np.uint8).reshape(shape)
    )


def assign_roles(crowd: CrowdSettings, persons: int) -> list[Role]:
    """Return everyone's role, in the order of `worldpose.simulation.movements`."""
    roles: list[Role] = ["first" if person % 2 == 0 else "second" for person in range(persons)]
    if crowd.movement == "football":
        keepers: list[Role] = ["first keeper", "second keeper"]
        roles[:2] = keepers[: min(2, persons)]
        for official in range(max(persons - crowd.officials, 0), persons):
            roles[official] = "official"
    elif crowd.movement == "corner" and persons:
        roles[-1] = "second keeper"
    return roles
