"""Where painted lines lie in a picture, measured across them with sub-pixel accuracy (C4).

A painted line has two edges, and an edge detector finds either: half a width beside the template's
line. Here brightness is read across the projected line, and a bar as wide as the projected paint
between two levels of grass is fitted to it. The edge of a mown stripe or of a shadow is bright on
one side only and is no bar; a line along such an edge keeps its centre, as the levels are separate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from worldpose.compiled import compiled
from worldpose.errors import InputError

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]
Integers = NDArray[np.int64]

CANDIDATES: Final = 4
"""Bars that are kept across one place [1]."""
_STEP: Final = 0.5
"""Between readings across a line [px]."""
_ALONG: Final = 2
"""Readings are means over this many pixels to either side along the line."""
_FLANK: Final = 3.0
"""Grass that is looked at on either side of a bar [px]."""
_GAP: Final = 1.0
"""Blurred rim of a bar, neither paint nor grass [px]."""
_SOFT: Final = 0.45
"""Scale of the logistic edge that stands for blur: as a Gaussian of 0.75 px."""
_SHARED: Final = 1.3
"""Variance of a fit for that of independent readings [1]: those half a pixel apart share pixels;
measured with white noise."""
_FITTINGS: Final = 5
"""Gauss-Newton steps of a bar; it is found to a half pixel before."""


def median_picture(pictures: Sequence[Picture]) -> Picture:
    """Return the median of pictures of one camera: without the people who move.

    Raises:
        InputError: there are none, or their sizes differ.
    """
    sizes = {picture.shape for picture in pictures}
    if len(sizes) != 1:
        raise InputError(
            "median_picture",
            expected="one or more pictures of one size",
            found=f"sizes {sorted(sizes)}",
            todo="Give frames of one camera's clip.",
        )
    return np.asarray(np.median(np.stack(list(pictures)), axis=0).astype(np.uint8))


def brightness(picture: Picture) -> Picture:
    """Return the luma (height, width) of a picture; its colours have half the resolution in video.

    Raises:
        InputError: the picture is neither (height, width) nor (height, width, 3) of bytes.
    """
    if (
        picture.dtype != np.uint8
        or picture.ndim not in (2, 3)
        or picture.shape[2:] not in ((), (3,))
    ):
        raise InputError(
            "picture",
            expected="bytes of shape (height, width) or (height, width, 3)",
            found=f"{picture.dtype} of shape {picture.shape}",
            todo="Read the picture as 8-bit grey or RGB.",
        )
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return np.ascontiguousarray(picture)


@compiled
def find_bars(
    grey: Picture,
    places: Floats,
    normals: Floats,
    widths: Floats,
    reaches: Floats,
    contrast: float,
    offsets: Floats,
    strengths: Floats,
) -> None:
    """Write bright bars across places, the strongest first.

    Args:
        grey: (height, width).
        places: (n, 2) [px].
        normals: (n, 2) unit vectors across the line.
        widths: (n,) of the bar [px].
        reaches: (n,) how far to look to either side [px]; negative = not at all.
        contrast: least brightness above both sides [levels of 255].
        offsets: (n, CANDIDATES) along the normal [px], written; NaN where there are no more.
        strengths: (n, CANDIDATES) brightness above the brighter side, written.
    """
    for i in range(len(places)):
        offsets[i] = np.nan
        strengths[i] = 0.0
        half = max(0.5 * widths[i], 0.5)
        rim = half + _GAP + _FLANK
        if not reaches[i] >= 0.0:
            continue
        count = 2 * int(np.ceil((reaches[i] + rim) / _STEP)) + 1
        profile = np.empty(count)
        _read(grey, places[i], normals[i], profile)
        sums = np.zeros(count + 1)
        begin, end = count, 0
        for j in range(count):
            inside = not np.isnan(profile[j])
            sums[j + 1] = sums[j] + (profile[j] if inside else 0.0)
            if inside:
                begin, end = min(begin, j), j + 1
        core, gap, flank = int(half / _STEP), int(_GAP / _STEP), int(_FLANK / _STEP)
        first = core + gap + flank
        score = np.full(count, -np.inf)
        for j in range(begin + first, end - first):
            inner, outer = j - core - gap, j + core + gap + 1
            left = (sums[inner] - sums[inner - flank]) / flank
            right = (sums[outer + flank] - sums[outer]) / flank
            middle = (sums[j + core + 1] - sums[j - core]) / (2 * core + 1)
            if middle - left > contrast and middle - right > contrast:
                score[j] = middle - max(left, right)
        found = 0
        for j in range(begin + first, end - first):
            best = score[j] > 0.0
            for near in range(max(j - 3, 0), min(j + 4, count)):
                if score[near] > score[j] or (score[near] == score[j] and near < j):
                    best = False
            if best:
                # Sorted in by strength; the weakest falls out when there are too many.
                slot = min(found, CANDIDATES - 1)
                if found >= CANDIDATES and score[j] <= strengths[i, slot]:
                    continue
                while slot > 0 and strengths[i, slot - 1] < score[j]:
                    offsets[i, slot], strengths[i, slot] = (
                        offsets[i, slot - 1],
                        strengths[i, slot - 1],
                    )
                    slot -= 1
                offsets[i, slot] = (j - count // 2) * _STEP
                strengths[i, slot] = score[j]
                found += 1


@compiled
def fit_bars(
    grey: Picture,
    places: Floats,
    normals: Floats,
    widths: Floats,
    starts: Floats,
    contrast: float,
    offsets: Floats,
    variances: Floats,
) -> None:
    """Write the exact place of bars, and how well the picture tells it.

    Args:
        grey: (height, width).
        places: (n, 2) [px].
        normals: (n, 2) unit vectors across the line.
        widths: (n,) of the bar [px].
        starts: (n,) along the normal [px], right to about a pixel; NaN = none.
        contrast: least brightness above both sides [levels of 255].
        offsets: (n,) along the normal [px], written; NaN where no bar fits.
        variances: (n,) [px^2], written.
    """
    for i in range(len(places)):
        offsets[i] = np.nan
        variances[i] = np.inf
        if np.isnan(starts[i]):
            continue
        half = max(0.5 * widths[i], 0.25)
        count = 2 * int(np.ceil((half + _GAP + _FLANK) / _STEP)) + 1
        profile = np.empty(count)
        middle = places[i] + starts[i] * normals[i]
        _read(grey, middle, normals[i], profile)
        # Both ends in the picture: all of a line across it is.
        if np.isnan(profile[0]) or np.isnan(profile[-1]):
            continue
        shift, contrast_left, contrast_right, variance = _fit_bar(profile, half)
        if (
            abs(shift) < 2.0
            and contrast_left > contrast
            and contrast_right > contrast
            and variance < np.inf
        ):
            offsets[i] = starts[i] + shift
            variances[i] = variance


@compiled
def _read(grey: Picture, place: Floats, normal: Floats, profile: Floats) -> None:
    """Write brightness across a line, its middle entry at `place`; NaN outside the picture."""
    height, width = grey.shape
    for j in range(len(profile)):
        t = (j - len(profile) // 2) * _STEP
        total = 0.0
        for k in range(-_ALONG, _ALONG + 1):
            x = place[0] + t * normal[0] - k * normal[1]
            y = place[1] + t * normal[1] + k * normal[0]
            if not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0):
                total = np.nan
                break
            u, v = int(x), int(y)
            fx, fy = x - u, y - v
            total += (1.0 - fy) * ((1.0 - fx) * grey[v, u] + fx * grey[v, u + 1])
            total += fy * ((1.0 - fx) * grey[v + 1, u] + fx * grey[v + 1, u + 1])
        profile[j] = total / (2 * _ALONG + 1)


@compiled
def _fit_bar(profile: Floats, half: float) -> tuple[float, float, float, float]:
    """Return a bar's offset [px], its height above either side, and the offset's variance.

    The variance is infinite where nothing fits.
    """
    count = len(profile)
    shift = 0.0
    level = np.zeros(4)  # grass, paint, grass; the last entry is not used
    normal, right = np.empty((4, 4)), np.empty(4)
    row = np.empty(4)
    variance = np.inf
    for fitting in range(_FITTINGS):
        normal[:] = 0.0
        right[:] = 0.0
        squares = 0.0
        for j in range(count):
            t = (j - count // 2) * _STEP - shift
            rise = 1.0 / (1.0 + math.exp(-(t + half) / _SOFT))
            fall = 1.0 / (1.0 + math.exp(-(t - half) / _SOFT))
            row[0], row[1], row[2] = 1.0 - rise, rise - fall, fall
            # The levels come with the first step, the place from the second on.
            up, down = level[1] - level[0], level[1] - level[2]
            row[3] = (down * fall * (1.0 - fall) - up * rise * (1.0 - rise)) / _SOFT
            rest = profile[j] - level[0] * row[0] - level[1] * row[1] - level[2] * row[2]
            squares += rest * rest
            for a in range(4):
                right[a] += row[a] * rest
                for b in range(a + 1):
                    normal[a, b] += row[a] * row[b]
        if fitting == 0:
            normal[3, 3] = 1.0
        pivot = _solve(normal, right)
        if not pivot > 0.0:
            return shift, 0.0, 0.0, np.inf
        level += right
        if fitting > 0:
            shift += min(max(right[3], -1.0), 1.0)
            variance = max(squares / (count - 4), 0.25) / pivot
        if not abs(shift) < 3.0 or (fitting > 0 and abs(right[3]) < 0.01):
            break
    return shift, level[1] - level[0], level[1] - level[2], _SHARED * variance


@compiled
def _solve(normal: Floats, right: Floats) -> float:
    """Replace `right` by the solution; return the last unknown's information, 0 if singular.

    Args:
        normal: (n, n) positive definite, its lower half is used and lost.
        right: (n,).
    """
    size = len(right)
    for a in range(size):
        for b in range(a):
            for c in range(b):
                normal[a, b] -= normal[a, c] * normal[b, c] * normal[c, c]
            normal[a, b] /= normal[b, b]
        for c in range(a):
            normal[a, a] -= normal[a, c] ** 2 * normal[c, c]
        if not normal[a, a] > 1e-9:
            return 0.0
        for b in range(a):
            right[a] -= normal[a, b] * right[b]
    for a in range(size - 1, -1, -1):
        right[a] /= normal[a, a]
        for b in range(a + 1, size):
            right[a] -= normal[b, a] * right[b]
    return float(normal[size - 1, size - 1])
