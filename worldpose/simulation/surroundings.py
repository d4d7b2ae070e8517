"""Colours of a stadium's surfaces: grass, painted markings, boards, a track, stands with a crowd.

The painted share of a pixel follows from the distance to each marking over the pixel's footprint.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from worldpose.compiled import compile_kernel
from worldpose.pitch.laws import prescribed_points
from worldpose.pitch.template import PitchTemplate

LINE_WIDTH: Final = 0.12
"""Width of the painted markings, centred on the template's line [m] (Law 1)."""
_LINE, _ARC, _SPOT = 0.0, 1.0, 2.0


def paint_rows(pitch: PitchTemplate) -> Floats:
    """Return a row (8,) per painted marking, for `paint_cover` [m, rad], heights above the crown.

    A row is its kind and then, of a line, x and y of start and direction, length, height of start
    and end; of an arc x and y of the center, radius, start angle, span, height, 0; of a spot x and
    y of the center, radius, 0, 0, height, 0.
    """
    spot_radius = 0.11  # radius of the painted centre and penalty marks [m]

    def above(name: str) -> tuple[float, float, float]:
        x, y, z = (float(value) for value in pitch.points[name])
        return x, y, z - float(pitch.height(x, y))

    rows: list[tuple[float, ...]] = []
    for line in pitch.lines.values():
        (x0, y0, h0), (x1, y1, h1) = above(line.start), above(line.end)
        length = math.hypot(x1 - x0, y1 - y0)
        rows.append((_LINE, x0, y0, (x1 - x0) / length, (y1 - y0) / length, length, h0, h1))
    for arc in pitch.arcs.values():
        x, y, h = above(arc.center)
        span = arc.end_angle - arc.start_angle
        rows.append((_ARC, x, y, arc.radius, arc.start_angle, span, h, 0.0))
    for name in (name for name in prescribed_points(pitch.spec) if "mark" in name.split("_")):
        x, y, h = above(name)
        rows.append((_SPOT, x, y, spot_radius, 0.0, 0.0, h, 0.0))
    return np.array(rows, dtype=np.float64)


@compile_kernel
def surface_hit(o: Floats, dx: float, dy: float, dz: float, bend: Floats) -> float:
    """Return the steps (dx, dy, dz) from `o` to the surface; inf if none.

    Its height is -bend[0] x^2 - bend[1] y^2.
    """
    a = bend[0] * dx * dx + bend[1] * dy * dy
    b = dz + 2.0 * (bend[0] * o[0] * dx + bend[1] * o[1] * dy)
    c = o[2] + bend[0] * o[0] * o[0] + bend[1] * o[1] * o[1]
    root = b * b - 4.0 * a * c
    if root < 0.0:
        return np.inf
    below = -b + np.sqrt(root)
    return 2.0 * c / below if below > 0.0 else np.inf


@compile_kernel
def _below(t: float, wide: float, narrow: float) -> float:
    """Return the share of a pixel below t, in the middle of widths |du|, |dv| of a ramp."""
    sum_half, diff_half = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    if t <= -sum_half:
        return 0.0
    if t >= sum_half:
        return 1.0
    if abs(t) <= diff_half:
        return 0.5 + t / wide
    rest = sum_half - abs(t)
    corner = 0.5 * rest * rest / (wide * narrow)
    return 1.0 - corner if t > 0.0 else corner


@compile_kernel
def _share(t: float, du: float, dv: float, low: float, high: float) -> float:
    """Return the share of a pixel with low < t < high, where t changes by du and dv per pixel."""
    a, b = abs(du), abs(dv)
    wide, narrow = max(a, b, 1e-9), max(min(a, b), 1e-9)
    return _below(high - t, wide, narrow) - _below(low - t, wide, narrow)


@compile_kernel
def paint_cover(paint: Floats, place: Floats) -> float:
    """Return the painted share of a pixel.

    `paint` (n, 8) is of `paint_rows`; `place` (8,) is x y on the surface, their changes by a pixel
    to the right and one down, and by a metre of height.
    """
    bare = 1.0
    half = 0.5 * LINE_WIDTH
    reach = half + 0.5 * (abs(place[2]) + abs(place[3]) + abs(place[4]) + abs(place[5]))
    for row in range(len(paint)):
        if paint[row, 0] == _LINE:
            ex, ey, length = paint[row, 3], paint[row, 4], paint[row, 5]
            x, y = place[0] - paint[row, 1], place[1] - paint[row, 2]
            if abs(ex * y - ey * x) > reach + 0.2:
                continue
            along = min(max((ex * x + ey * y) / length, 0.0), 1.0)
            height = (1.0 - along) * paint[row, 6] + along * paint[row, 7]
            x, y = x + height * place[6], y + height * place[7]
            cover = _share(
                ex * y - ey * x,
                ex * place[3] - ey * place[2],
                ex * place[5] - ey * place[4],
                -half,
                half,
            )
            if cover > 0.0:
                cover *= _share(
                    ex * x + ey * y,
                    ex * place[2] + ey * place[3],
                    ex * place[4] + ey * place[5],
                    -half,
                    length + half,
                )
            bare *= 1.0 - cover
            continue
        x = place[0] + paint[row, 6] * place[6] - paint[row, 1]
        y = place[1] + paint[row, 6] * place[7] - paint[row, 2]
        radius = x * x + y * y
        inner = paint[row, 3] - half if paint[row, 0] == _ARC else -1.0
        outer = paint[row, 3] + half if paint[row, 0] == _ARC else paint[row, 3]
        if radius > (outer + reach) ** 2 or radius < max(inner - reach, 0.0) ** 2:
            continue
        radius = np.sqrt(radius)
        nx, ny = (x / radius, y / radius) if radius > 1e-9 else (1.0, 0.0)
        du, dv = nx * place[2] + ny * place[3], nx * place[4] + ny * place[5]
        cover = _share(radius, du, dv, inner, outer)
        if cover > 0.0 and paint[row, 0] == _ARC and paint[row, 5] < 2.0 * math.pi - 1e-6:
            turn = (np.arctan2(y, x) - paint[row, 4]) % (2.0 * math.pi)
            past = turn - paint[row, 5]
            if past > 0.5 * (2.0 * math.pi - paint[row, 5]):
                turn -= 2.0 * math.pi
            du, dv = nx * place[3] - ny * place[2], nx * place[5] - ny * place[4]
            cover *= _share(turn * paint[row, 3], du, dv, 0.0, paint[row, 5] * paint[row, 3])
        bare *= 1.0 - cover
    return 1.0 - bare


@compile_kernel
def texture(table: Floats, x: float, y: float) -> float:
    """Return a smooth periodic pattern at (x, y), one cell of the (64, 64) table per unit."""
    ix, iy = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    i0, i1, j0, j1 = ix & 63, (ix + 1) & 63, iy & 63, (iy + 1) & 63
    top = (1.0 - fx) * table[j0, i0] + fx * table[j0, i1]
    bottom = (1.0 - fx) * table[j1, i0] + fx * table[j1, i1]
    return float((1.0 - fy) * top + fy * bottom)


@compile_kernel
def grass(
    table: Floats, place: Floats, length: float, width: float, stripes: float
) -> tuple[float, float]:
    """Return brightness (1 on average) and yellowness of the grass.

    `table` (64, 64) has numbers about 0 with spread 1; `place` is as in `paint_cover`; length and
    width are the pitch's [m]; `stripes` is the brightness of a stripe against its neighbour.
    """
    stripe = 5.5  # width of a mown stripe: a third of the penalty area's depth [m]
    x, y = place[0], place[1]
    size = abs(place[2]) + abs(place[3]) + abs(place[4]) + abs(place[5])
    # A steep triangle wave: 0.15 m of half-turned grass between stripes, or a pixel.
    phase = ((x + 0.5 * length) / stripe + 0.5) % 2.0
    ramp = (0.5 - abs(phase - 1.0)) * 2.0 * stripe / max(0.3, size)
    bright = 1.0 + 0.5 * stripes * min(max(ramp, -1.0), 1.0)
    broad = texture(table, x / 6.3, y / 6.3)
    bright += 0.022 * broad + 0.02 * texture(table, x / 1.1 + 17.0, y / 1.1)
    fine = min(0.12 / size, 1.0)
    bright += 0.05 * fine * texture(table, x / 0.13, y / 0.13 + 31.0)
    yellow = 0.5 * broad + texture(table, x / 14.0 + 40.0, y / 9.0)
    if abs(x) > 0.5 * length + 2.0 or abs(y) > 0.5 * width + 2.0:
        bright = 0.5 * bright + 0.42
    return bright, yellow


@compile_kernel
def wear(table: Floats, place: Floats) -> float:
    """Return the wear of paint at a place: about 0 with spread of about a half."""
    x, y = place[0], place[1]
    fine = texture(table, x / 0.9, y / 0.9 + 9.0)
    return 0.5 * fine + 0.5 * texture(table, x / 4.0, y / 4.0)


BOARD_SETBACK: Final = (5.0, 4.0)
"""Distance of the boards from the goal lines and from the touch lines [m]."""
BOARD_HEIGHT: Final = 0.95
"""[m]"""


@compile_kernel
def _hash(i: int, j: int, k: int) -> float:
    """Return a pseudorandom number in [0, 1) that depends on three numbers."""
    value = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    value = (value ^ (value >> 13)) * 1274126177 & 0xFFFFFFFF
    value = (value ^ (value >> 16)) * 668265263 & 0xFFFFFFFF
    return float((value ^ (value >> 15)) & 0xFFFFFF) / 16777216.0


@compile_kernel
def _board(along: float, up: float, side: int, look: int) -> tuple[float, float, float]:
    """Return the colour of a board: panels in strong colours with rows of letter-like blocks."""
    panel_m = 7.0
    panel = int(np.floor(along / panel_m))
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
    at = along - panel * panel_m
    if up < 0.04 or up > BOARD_HEIGHT - 0.03:
        return 0.30, 0.30, 0.31
    letter_m = 0.42
    if 0.25 < up < 0.75 and 0.8 < at < panel_m - 0.8:
        letter, part = int(np.floor(at / letter_m)), (at / letter_m) % 1.0
        row, column = int((up - 0.25) / 0.5 * 3.0), int(part * 4.0)
        if column < 3 and _hash(letter, 4 * row + column, panel + 7 * side + look) < 0.62:
            if base[0] + base[1] > 1.2:
                return 0.05, 0.06, 0.10
            return 0.93, 0.93, 0.92
    return base


@compile_kernel
def _crowd(along: float, z: float, side: int, look: int) -> tuple[float, float, float]:
    """Return the colour at a place of a stand: a spectator that detectors may find, or a seat."""
    row_m = 0.45
    seat_m = 0.52
    row, seat = int(z / row_m), int(along / seat_m)
    x, up = along - (seat + 0.5) * seat_m, z - row * row_m
    low = 0.45 + 0.55 * up / row_m
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


@compile_kernel
def scenery(
    o: Floats, dx: float, dy: float, dz: float, half: Floats, bend: Floats, look: int
) -> tuple[float, float, float, float]:
    """Return the colour at a ray's end, and the distance in steps; grass gives (-1, 0, 0).

    The ray begins at `o` (3,) [m], world. `half` (2,) are half the distances between the boards
    along x and y [m], `bend` (2,) is that of `surface_hit`, `look` seeds the stadium's look.
    """
    stand_top = 24.0
    stand_slope = 0.55
    stand_setback = 4.0
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
            ahead, across = o[0] + steps * dx, o[1] + steps * dy
            up = o[2] + steps * dz + bend[0] * ahead * ahead + bend[1] * across * across
            if abs(along) < half[1 - axis] and up < BOARD_HEIGHT:
                nearest = steps
                if toward * step > 0.0:
                    red, green, blue = _board(along + 200.0, up, side, look)
                else:
                    red, green, blue = 0.13, 0.13, 0.14
        # A stand is a plane that rises outwards from behind the track. A camera below it is built
        # into it and looks out.
        rise = dz - stand_slope * toward * step
        below = stand_slope * (toward * start - half[axis] - stand_setback) - o[2]
        if rise == 0.0 or below >= 0.0:
            continue
        steps = below / rise
        if 0.0 < steps < nearest:
            z = o[2] + steps * dz
            along = o[1] + steps * dy if axis == 0 else o[0] + steps * dx
            # Where two stands meet, the higher one is visible.
            other = abs(along) - half[1 - axis] - stand_setback
            if 0.0 < z < stand_top and z >= stand_slope * other:
                nearest = steps
                if z < 1.2:
                    red, green, blue = 0.36, 0.36, 0.37
                elif (along + 300.0) % 22.0 < 1.1 or z % 8.0 < 0.5:
                    red, green, blue = 0.33, 0.33, 0.34
                else:
                    red, green, blue = _crowd(along + 300.0, z, side, look + 10 * side)
    return red, green, blue, nearest
