"""Surroundings of the pitch in an image: advertising boards, a track, stands with a crowd."""

from __future__ import annotations

from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import compiled
from worldpose.simulation.turf import surface_hit

BOARD_SETBACK: Final = (5.0, 4.0)
"""From the goal lines and from the touch lines [m]."""
BOARD_HEIGHT: Final = 0.95
"""[m]"""
_PANEL = 7.0
_LETTER = 0.42
_STAND_SETBACK = 4.0
_STAND_SLOPE = 0.55
_STAND_TOP = 24.0
_ROW = 0.45
_SEAT = 0.52


@compiled
def _hash(i: int, j: int, k: int) -> float:
    """Return a pseudorandom number in [0, 1) that depends on three numbers."""
    value = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    value = (value ^ (value >> 13)) * 1274126177 & 0xFFFFFFFF
    value = (value ^ (value >> 16)) * 668265263 & 0xFFFFFFFF
    return float((value ^ (value >> 15)) & 0xFFFFFF) / 16777216.0


@compiled
def _board(along: float, up: float, side: int, look: int) -> tuple[float, float, float]:
    """Return the colour of a board: panels in strong colours with rows of letter-like blocks."""
    panel = int(np.floor(along / _PANEL))
    hue = _hash(panel, side, look)
    if hue < 0.25:
        base = (0.85, 0.86, 0.88)
    elif hue < 0.5:
        base = (0.06, 0.10, 0.32)
    elif hue < 0.7:
        base = (0.62, 0.05, 0.07)
    elif hue < 0.85:
        base = (0.04, 0.05, 0.05)
    else:
        base = (0.85, 0.68, 0.05)
    at = along - panel * _PANEL
    if up < 0.04 or up > BOARD_HEIGHT - 0.03:
        return 0.30, 0.30, 0.31
    if 0.25 < up < 0.75 and 0.8 < at < _PANEL - 0.8:
        letter, part = int(np.floor(at / _LETTER)), (at / _LETTER) % 1.0
        row, column = int((up - 0.25) / 0.5 * 3.0), int(part * 4.0)
        if column < 3 and _hash(letter, 4 * row + column, panel + 7 * side + look) < 0.62:
            if base[0] + base[1] > 1.2:
                return 0.05, 0.06, 0.10
            return 0.93, 0.93, 0.92
    return base


@compiled
def _crowd(along: float, z: float, side: int, look: int) -> tuple[float, float, float]:
    """Return the colour at a place of a stand: a seated spectator or an empty seat.

    Head, hair and shoulders in some jacket, a part of each block in the colours of one club: a
    person detector finds them and a filter must drop them.
    """
    row, seat = int(z / _ROW), int(along / _SEAT)
    x, up = along - (seat + 0.5) * _SEAT, z - row * _ROW
    low = 0.45 + 0.55 * up / _ROW
    kind = _hash(row, seat, look)
    if kind < 0.15 or up > 0.41:
        empty = abs(x) < 0.21 and up < 0.34
        return (0.10 * low, 0.16 * low, 0.34 * low) if empty else (0.05, 0.07, 0.12)
    x -= 0.1 * (_hash(row, seat, look + 4) - 0.5)
    up -= 0.08 * (_hash(row, seat, look + 5) - 0.5)
    head_x, head_z = x / 0.09, (up - 0.315) / 0.1
    if head_x * head_x + head_z * head_z < 1.0:
        tone = 0.2 + 0.6 * _hash(row, seat, look + 6) ** 0.7
        if head_z > 0.25 + 0.5 * _hash(row, seat, look + 7):
            hair = 0.03 + 0.2 * _hash(row, seat, look + 8) ** 2
            return hair, 0.8 * hair, 0.65 * hair
        return tone, 0.74 * tone, 0.62 * tone
    # Shoulders slope from the neck.
    if up < 0.26 and abs(x) < min(0.07 + 1.6 * (0.26 - up), 0.235):
        if _hash(row, seat, look + 9) < 0.35:
            club = int(along / 44.0) + 7 * side
            red, green, blue = _hash(club, 1, look), _hash(club, 2, look), _hash(club, 3, look)
            return 0.75 * low * red, 0.75 * low * green, 0.75 * low * blue
        red, green, blue = _hash(row, seat, look + 1), _hash(row, seat, look + 2), kind
        dim = low * (0.10 + 0.6 * _hash(row, seat, look + 3) ** 2)
        return dim * (0.6 + 0.4 * red), dim * (0.6 + 0.3 * green), dim * (0.6 + 0.4 * blue)
    return 0.06 * low, 0.08 * low, 0.14 * low


@compiled
def scenery(
    o: Floats, dx: float, dy: float, dz: float, half: Floats, bend: float, look: int
) -> tuple[float, float, float, float]:
    """Return the colour at a ray's end, and the distance in steps; grass gives (-1, 0, 0).

    Args:
        o: (3,) origin of the ray [m], world.
        dx: direction along x.
        dy: direction along y.
        dz: direction upwards.
        half: (2,) half the distances between the boards along x and y [m].
        bend: the surface is z = -bend y^2.
        look: seed of the stadium's look.
    """
    nearest = surface_hit(o, dx, dy, dz, bend)
    x, y = o[0] + nearest * dx, o[1] + nearest * dy
    red, green, blue = -1.0, 0.0, 0.0
    out = max(abs(x) - half[0], abs(y) - half[1])
    if not nearest < np.inf:
        red, green, blue = 0.045, 0.05, 0.06
    elif out > 0.0:
        grey = 0.30 + 0.05 * _hash(int(np.floor(x / 1.5)), int(np.floor(y / 1.5)), look)
        red, green, blue = grey, grey * 1.01, grey * 1.02
    for side in range(4):
        axis = side // 2
        toward = 1.0 if side % 2 == 0 else -1.0
        start, step = (o[0], dx) if axis == 0 else (o[1], dy)
        if step == 0.0:
            continue
        steps = (toward * half[axis] - start) / step
        if 0.0 < steps < nearest:
            along = o[1] + steps * dy if axis == 0 else o[0] + steps * dx
            across = o[1] + steps * dy
            up = o[2] + steps * dz + bend * across * across
            if abs(along) < half[1 - axis] and up < BOARD_HEIGHT:
                nearest = steps
                if toward * step > 0.0:
                    red, green, blue = _board(along + 200.0, up, side, look)
                else:
                    red, green, blue = 0.13, 0.13, 0.14
        # A stand is a plane that rises outwards from behind the track. A camera below it is built
        # into it and looks out.
        rise = dz - _STAND_SLOPE * toward * step
        below = _STAND_SLOPE * (toward * start - half[axis] - _STAND_SETBACK) - o[2]
        if rise == 0.0 or below >= 0.0:
            continue
        steps = below / rise
        if 0.0 < steps < nearest:
            z = o[2] + steps * dz
            along = o[1] + steps * dy if axis == 0 else o[0] + steps * dx
            # Where two stands meet, the higher one is visible.
            other = abs(along) - half[1 - axis] - _STAND_SETBACK
            if 0.0 < z < _STAND_TOP and z >= _STAND_SLOPE * other:
                nearest = steps
                if z < 1.2:
                    red, green, blue = 0.36, 0.36, 0.37
                elif (along + 300.0) % 22.0 < 1.1 or z % 8.0 < 0.5:
                    red, green, blue = 0.33, 0.33, 0.34
                else:
                    red, green, blue = _crowd(along + 300.0, z, side, look + 10 * side)
    return red, green, blue, nearest
