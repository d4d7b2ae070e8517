"""Detection of painted lines in an image, on profiles across them (C4).

A painted line has two edges, and an edge detector finds either: half a width off the template's
line. This module samples brightness across the projected line, where paint is a bar of the
projected width. The edge of a mown stripe or of a shadow is bright on one side only and is no bar.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from data_contracts.arrays import Floats, Image
from worldpose.compiled import compiled
from worldpose.errors import InputError

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
BESIDE: Final = _GAP + _FLANK
"""Minimum distance of a bar from other structures [px]."""


def brightness(picture: Image) -> Image:
    """Return the luma (height, width) of an image; chroma has half the resolution in video.

    Raises:
        InputError: the image is neither (height, width) nor (height, width, 3) of bytes.
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
    grey: Image,
    places: Floats,
    normals: Floats,
    widths: Floats,
    curvatures: Floats,
    reaches: Floats,
    contrast: float,
    offsets: Floats,
    strengths: Floats,
) -> None:
    """Write the bright bars found across places, the strongest first.

    Args:
        grey: (height, width).
        places: (n, 2) [px].
        normals: (n, 2) unit vectors across the line.
        widths: (n,) of the bar [px].
        curvatures: (n,) of the line, positive where it turns towards its normal [1/px].
        reaches: (n,) half width of the search [px]; negative = no search.
        contrast: minimum brightness above both sides [levels of 255].
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


@compiled
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
