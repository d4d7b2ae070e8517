"""Textures of people: kits, skin and hair, front and back in the T-pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.simulation.looks import PATTERNS, Pattern
from worldpose.simulation.mannequins import (
    BOOT,
    HAIRLINE,
    HEM,
    KNEE,
    LEFT,
    SIZE,
    SLEEVE,
    TEXEL,
    TOP,
    WAIST,
)

Bytes = NDArray[np.uint8]
Role = Literal["first", "second", "first keeper", "second keeper", "official"]
_CLOTH: Final = np.array(
    [
        [0.76, 0.07, 0.10],
        [0.90, 0.91, 0.93],
        [0.10, 0.22, 0.58],
        [0.42, 0.66, 0.88],
        [0.07, 0.07, 0.08],
        [0.93, 0.78, 0.12],
        [0.08, 0.42, 0.24],
        [0.45, 0.07, 0.16],
        [0.93, 0.45, 0.08],
        [0.33, 0.16, 0.48],
        [0.06, 0.10, 0.25],
        [0.10, 0.55, 0.58],
    ]
)
_BRIGHT: Final = np.array(
    [[0.80, 0.95, 0.15], [0.97, 0.42, 0.60], [0.15, 0.80, 0.45], [0.98, 0.60, 0.10]]
)
"""Of goalkeepers and officials."""
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
    """Of the socks."""
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
    keepers = [_keeper_kit(_jittered(_BRIGHT[k], rng), rng) for k in order[:2]]
    black = np.array([0.06, 0.06, 0.07])
    shirt = _jittered(black if rng.random() < 0.5 else _BRIGHT[order[2]], rng)
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
        _jittered(shirt, rng),
        _jittered(second, rng),
        pattern,
        _jittered(shorts, rng),
        _jittered(socks, rng),
        second,
        SLEEVE,
    )


def _keeper_kit(shirt: Floats, rng: np.random.Generator) -> Kit:
    shorts = shirt if rng.random() < 0.5 else _CLOTH[4]
    return Kit(shirt, 0.7 * shirt, "sleeves", shorts, shirt, shorts, 0.74, gloves=True)


def _jittered(color: Floats, rng: np.random.Generator) -> Floats:
    return np.clip(color + rng.normal(0.0, 0.025, 3), 0.02, 0.97)


def paint_person(kit: Kit, number: int | None, rng: np.random.Generator) -> Bytes:
    """Return the textures (2, SIZE, SIZE, 3) of one person's front and back, in the T-pose.

    Args:
        kit: the person's clothes.
        number: on shirt and shorts.
        rng: draws skin, hair, boots and the folds of the cloth.
    """
    x = LEFT + TEXEL * (np.arange(SIZE) + 0.5)
    y = TOP - TEXEL * (np.arange(SIZE) + 0.5)
    x, y = np.meshgrid(x, y)
    tone = rng.beta(1.1, 0.9)
    skin = (1.0 - tone) * _DARK + tone * _LIGHT
    shade = _HAIR[0] if tone < 0.35 else _HAIR[int(rng.choice(4, p=[0.35, 0.35, 0.2, 0.1]))]
    style, bearded = rng.random(), rng.random() < 0.4
    boots = _CLOTH[4] if rng.random() < 0.4 else _jittered(_BRIGHT[rng.integers(4)], rng)
    sides = np.empty((2, SIZE, SIZE, 3))
    for side, picture in enumerate(sides):
        picture[:] = skin
        _paint_head(picture, x, y, skin, shade, style, bearded=bearded, front=side == 0)
        # Cloth is cast in folds.
        folds = _folds(rng)[..., None]
        shirt = (y > WAIST) & (y < 0.335) & (np.abs(x) < kit.sleeve)
        # A neck, lower in front.
        shirt &= ~((np.abs(x) < 0.075) & (y > (0.285 if side == 0 else 0.32)))
        cloth = _patterned(kit, x, y)
        if number is not None:
            _print_number(cloth, kit, number, back=side == 1)
        picture[shirt] = (cloth * folds)[shirt]
        shorts = (y <= WAIST) & (y > HEM)
        stripe = np.abs(np.abs(x) - 0.185) < 0.015
        picture[shorts] = (kit.shorts * folds)[shorts]
        picture[shorts & stripe] = kit.second
        socks = (y <= KNEE) & (y > BOOT)
        picture[socks] = (kit.socks * (0.5 + 0.5 * folds))[socks]
        picture[socks & (y > KNEE - 0.05)] = kit.tops
        picture[y <= BOOT] = boots
        picture[y <= -1.185] = 0.75 * boots
        if kit.gloves:
            picture[np.abs(x) > 0.74] = kit.second
    return np.asarray(np.clip(np.rint(255.0 * sides), 0.0, 255.0), dtype=np.uint8)


def _paint_head(
    picture: Floats,
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
            picture[eye] = 0.35 * skin
            brow = (np.abs(x - side * 0.032) < 0.02) & (np.abs(y - 0.538) < 0.007)
            picture[brow] = 0.5 * skin
        mouth = (np.abs(x) < 0.024) & (np.abs(y - 0.434) < 0.007)
        picture[mouth] = skin * [0.75, 0.55, 0.55]
        if bearded and style > 0.1:
            chin = (y < 0.45) & (y > 0.385) & (np.abs(x) < 0.075) & ~mouth
            picture[chin] = 0.45 * skin + 0.55 * hair
    if style > 0.1:
        picture[covered] = hair


def _patterned(kit: Kit, x: Floats, y: Floats) -> Floats:
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
