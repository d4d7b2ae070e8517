"""Paint of far lines, thinner than a pixel, along their projection by a known camera."""

from __future__ import annotations

import cv2
import numpy as np

from data_contracts.arrays import Flags, Floats, Image, Integers
from worldpose.static_calibration.from_paint.paint import smooth_lightness


def trace_marking(picture: Image, pixels: Floats) -> Floats:
    """Return pixels (n, 2) on thin paint along a projected marking; none if there is no clear one.

    The paint of a far line is thinner than a pixel and a few pixels away from its projection (m, 2)
    [px], NaN where not visible, among letters, boards and people. The ridge that follows one smooth
    curve is the paint.
    """
    fewest = 15  # cross sections; fewer lie on a curve by chance
    height, width = picture.shape[:2]
    inside = ((pixels >= 0.0) & (pixels <= [width - 1.0, height - 1.0])).all(axis=1)
    pixels = pixels[inside]
    if len(pixels) < 2:
        return np.zeros((0, 2))
    lengths = np.append(0.0, np.linalg.norm(np.diff(pixels, axis=0), axis=1).cumsum())
    # Errors of paint are correlated over 8 px.
    places = np.arange(0.0, lengths[-1], 8.0)
    if len(places) < fewest:
        return np.zeros((0, 2))
    at = np.stack([np.interp(places, lengths, pixels[:, axis]) for axis in (0, 1)], axis=1)
    along = np.gradient(at, axis=0)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    row, ridge = _find_section_ridges(picture, at, normals)
    if len(np.unique(row)) < fewest:
        return np.zeros((0, 2))
    share = row / max(1, len(places) - 1)
    on = _follow_curve(row, share, ridge)
    if len(np.unique(row[on])) < max(fewest, 0.4 * len(places)):
        return np.zeros((0, 2))
    others = ~np.isin(row, row[on]) | (np.abs(ridge - _curve(share[on], ridge[on], share)) > 3.0)
    rival = _follow_curve(row[others], share[others], ridge[others])
    if len(np.unique(row[others][rival])) > 0.75 * len(np.unique(row[on])):
        return np.zeros((0, 2))
    return np.asarray(at[row[on]] + ridge[on, None] * normals[row[on]])


def _find_section_ridges(picture: Image, at: Floats, normals: Floats) -> tuple[Integers, Floats]:
    """Return the cross sections (k,) of ridges, and the ridges' offsets (k,) in them [px]."""
    step = 0.5  # [px]
    reach = 0.004 * picture.shape[1]
    offsets = np.arange(-reach, reach + step, step)
    pixels = (at[:, None] + offsets[:, None] * normals[:, None]).astype(np.float32)
    profiles = cv2.remap(
        smooth_lightness(picture), pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR
    )
    side = round(2.0 / step)
    flanks = np.maximum(profiles[:, : -2 * side], profiles[:, 2 * side :])
    contrast = profiles[:, side:-side] - flanks
    peak = contrast >= 6.0
    peak[:, 1:] &= contrast[:, 1:] >= contrast[:, :-1]
    peak[:, :-1] &= contrast[:, :-1] > contrast[:, 1:]
    row, column = np.nonzero(peak)
    return row, offsets[side:-side][column]


def _follow_curve(row: Integers, share: Floats, ridge: Floats) -> Flags:
    """Return which ridges (n,) lie on the parabola that passes most cross sections' ridges."""
    tolerance = 1.0  # from the curve of the marking [px]
    best = np.zeros(len(row), np.bool_)
    if len(np.unique(row)) < 3:
        return best
    rng = np.random.default_rng(0)
    for _ in range(400):
        chosen = rng.choice(len(row), 3, replace=False)
        if np.ptp(share[chosen]) < 0.3 or len(np.unique(row[chosen])) < 3:
            continue
        on = np.abs(ridge - _curve(share[chosen], ridge[chosen], share)) < tolerance
        if len(np.unique(row[on])) > len(np.unique(row[best])):
            best = on
    for _ in range(3 if best.any() else 0):
        best = np.abs(ridge - _curve(share[best], ridge[best], share)) < tolerance
    return best


def _curve(share: Floats, ridge: Floats, at: Floats) -> Floats:
    """Return the parabola through given places, at other places."""
    powers = np.arange(3)
    fitted = np.linalg.lstsq(share[:, None] ** powers, ridge, rcond=None)[0]
    return np.asarray(at[:, None] ** powers @ fitted)
