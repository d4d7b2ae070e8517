"""Detection of painted lines in an image, and their subpixel centers.

A painted line has two edges, and an edge detector finds either: half a width off the template's
line. This module samples brightness across the projected line, where paint is a bar of the
projected width. The edge of a mown stripe or of a shadow is bright on one side only and is no bar.

`fit_bars` fits a model to the pixels across a bar: a bar as wide as the projected paint, with
blurred edges, between two grass levels. The levels are separate, so that the edge of a mown stripe
or of a shadow does not bias the center.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.compiled import compile_kernel
from worldpose.errors import InputError
from worldpose.geometry.optimize.dense import solve_in_place

CANDIDATES: Final = 4
"""Maximum bar candidates per place [1]."""
_STEP: Final = 0.5
"""Spacing of samples across a line [px]."""
ALONG: Final = 2
"""Half length along the line of the window to detect and fit a bar in [px]."""
_FLANK: Final = 3.0
"""Width of the grass sample on either side of a bar [px]."""
_GAP: Final = 1.0
"""Width of a bar's blurred rim, neither paint nor grass [px]."""
CLEARANCE: Final = _GAP + _FLANK
"""Minimum distance of a bar from other structures [px]."""


def brightness(picture: Image) -> Image:
    """Return the luma (height, width) of an image; chroma has half the resolution in video.

    InputError if the image is neither (height, width) nor (height, width, 3) of bytes.
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
            todo="Read the image as 8-bit grey or RGB.",
        )
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return np.ascontiguousarray(picture)


class CrossSections(NamedTuple):
    """Places on projected lines across which to look for bars.

    Attributes:
        places: (n, 2) [px].
        normals: (n, 2) unit vectors across the line.
        widths: (n,) widths of the bar [px].
        curvatures: (n,) curvatures of the line, positive where it turns towards its normal [1/px].
    """

    places: Floats
    normals: Floats
    widths: Floats
    curvatures: Floats


@compile_kernel
def find_bars(
    grey: Image,
    sections: CrossSections,
    reaches: Floats,
    contrast: float,
    offsets: Floats,
    strengths: Floats,
) -> None:
    """Write the bright bars found across places, the strongest first.

    `sections` are n places on lines, `reaches` (n,) half the width of the search [px], negative =
    none; `contrast` is the minimum brightness above both sides. Written, (n, CANDIDATES): `offsets`
    along the normal [px], NaN where there are no more, and `strengths`, brightness above the
    brighter side.
    """
    places, normals = sections.places, sections.normals
    widths, curvatures = sections.widths, sections.curvatures
    for i in range(len(places)):
        offsets[i] = np.nan
        strengths[i] = 0.0
        half = max(0.5 * widths[i], 0.5)
        rim = half + _GAP + _FLANK
        if not reaches[i] >= 0.0:
            continue
        count = 2 * int(np.ceil((reaches[i] + rim) / _STEP)) + 1
        profile = np.empty(count)
        _read(grey, places[i], normals[i], curvatures[i], profile)
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
                # Insert by strength; the weakest drops out when there are too many.
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


@compile_kernel
def _read(grey: Image, place: Floats, normal: Floats, curvature: float, profile: Floats) -> None:
    """Write the brightness profile across a line, centered on `place`; NaN outside the image.

    Samples are means along the line and follow its curvature: at the ends of a flat ellipse, the
    tangent leaves the paint within a few pixels.
    """
    height, width = grey.shape
    for j in range(len(profile)):
        t = (j - len(profile) // 2) * _STEP
        total = 0.0
        for k in range(-ALONG, ALONG + 1):
            across = t + 0.5 * curvature * k * k
            x = place[0] + across * normal[0] - k * normal[1]
            y = place[1] + across * normal[1] + k * normal[0]
            if not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0):
                total = np.nan
                break
            u, v = int(x), int(y)
            fx, fy = x - u, y - v
            total += (1.0 - fy) * ((1.0 - fx) * grey[v, u] + fx * grey[v, u + 1])
            total += fy * ((1.0 - fx) * grey[v + 1, u] + fx * grey[v + 1, u + 1])
        profile[j] = total / (2 * ALONG + 1)


_BLUR: Final = 0.75
"""Standard deviation of a bar's edges [px]: of a sharp lens, 0.7, and of a pixel's own size."""


@compile_kernel
def fit_bars(
    grey: Image,
    sections: CrossSections,
    starts: Floats,
    contrast: float,
    offsets: Floats,
    variances: Floats,
) -> None:
    """Write the subpixel offsets of bars and their variances.

    `starts` (n,) along the normal of `sections` [px] are accurate to about a pixel, NaN = none;
    `contrast` is the minimum brightness above both sides. Written: `offsets` (n,) along the normal
    [px], NaN where no bar fits, and `variances` (n,) [px^2].
    """
    max_pixels = 1000  # no bar is 190 px wide
    places, normals = sections.places, sections.normals
    widths, curvatures = sections.widths, sections.curvatures
    across, values = np.empty(max_pixels), np.empty(max_pixels)
    for i in range(len(places)):
        offsets[i] = np.nan
        variances[i] = np.inf
        if np.isnan(starts[i]):
            continue
        half = max(0.5 * widths[i], 0.25)
        middle = places[i] + starts[i] * normals[i]
        count = _gather(grey, middle, normals[i], curvatures[i], half + CLEARANCE, across, values)
        if count == 0:
            continue
        shift, contrast_left, contrast_right, variance = _fit_bar(
            across[:count], values[:count], half
        )
        if (
            abs(shift) < 2.0
            and contrast_left > contrast
            and contrast_right > contrast
            and variance < np.inf
        ):
            # Blur moves a curved bar inwards.
            offsets[i] = starts[i] + shift - 0.5 * curvatures[i] * _BLUR**2
            variances[i] = variance


@compile_kernel
def _gather(
    grey: Image,
    place: Floats,
    normal: Floats,
    curvature: float,
    reach: float,
    across: Floats,
    values: Floats,
) -> int:
    """Write offsets across a line and the brightness of pixels about a place; return their count.

    No interpolation: between two pixels, the interpolated value of a line narrower than a pixel
    depends on the position of the line in the pixel. The count is 0 if pixels lie outside the
    image, or there are too many.
    """
    height, width = grey.shape
    wide = abs(normal[0]) * reach + abs(normal[1]) * ALONG
    tall = abs(normal[1]) * reach + abs(normal[0]) * ALONG
    left, right = math.ceil(place[0] - wide), math.floor(place[0] + wide)
    top, bottom = math.ceil(place[1] - tall), math.floor(place[1] + tall)
    if left < 0 or top < 0 or right >= width or bottom >= height:
        return 0
    count = 0
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            x, y = u - place[0], v - place[1]
            along = y * normal[0] - x * normal[1]
            t = x * normal[0] + y * normal[1] - 0.5 * curvature * along * along
            if abs(along) <= ALONG and abs(t) <= reach:
                if count == len(across):
                    return 0
                across[count] = t
                values[count] = grey[v, u]
                count += 1
    return count


@compile_kernel
def _fit_bar(across: Floats, values: Floats, half: float) -> tuple[float, float, float, float]:
    """Return a bar's offset [px], contrast to either side, variance [px^2], infinite if unfit."""
    count = len(across)
    shift = 0.0
    level = np.zeros(4)  # grass, paint, grass; the last entry is not used
    normal, right = np.empty((4, 4)), np.empty(4)
    row = np.empty(4)
    variance = np.inf
    root_2, root_2pi = math.sqrt(2.0), math.sqrt(2.0 * math.pi)
    # Gauss-Newton steps; the search before is accurate to half a pixel.
    for fitting in range(5):
        normal[:] = 0.0
        right[:] = 0.0
        squares = 0.0
        for j in range(count):
            low, high = (across[j] - shift + half) / _BLUR, (across[j] - shift - half) / _BLUR
            rise = 0.5 + 0.5 * math.erf(low / root_2)
            fall = 0.5 + 0.5 * math.erf(high / root_2)
            row[0], row[1], row[2] = 1.0 - rise, rise - fall, fall
            # The first step solves for the levels, later steps also for the offset.
            up, down = level[1] - level[0], level[1] - level[2]
            row[3] = down * math.exp(-0.5 * high * high) - up * math.exp(-0.5 * low * low)
            row[3] /= _BLUR * root_2pi
            rest = values[j] - level[0] * row[0] - level[1] * row[1] - level[2] * row[2]
            squares += rest * rest
            for a in range(4):
                right[a] += row[a] * rest
                for b in range(a + 1):
                    normal[a, b] += row[a] * row[b]
        if fitting == 0:
            normal[3, 3] = 1.0
        pivot = solve_in_place(normal, right, 1e-9)
        if not pivot > 0.0:
            return shift, 0.0, 0.0, np.inf
        level += right
        if fitting > 0:
            shift += min(max(right[3], -1.0), 1.0)
            variance = max(squares / (count - 4), 0.25) / pivot
        if not abs(shift) < 3.0 or (fitting > 0 and abs(right[3]) < 0.01):
            break
    return shift, level[1] - level[0], level[1] - level[2], variance
