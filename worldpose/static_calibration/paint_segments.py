"""Painted lines of an image whose camera is unknown: thin bright ridges on the pitch (C2).

`line_detection` looks for bars where a camera projects the markings. Here no camera is known: the
grass is the dominant green, paint is a thin ridge brighter than the grass on both of its sides, and
straight segments come from a Hough transform whose votes agree with the ridges' directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Integers
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

_WIDTHS: Final = (1280, 1920)
"""Minimum and maximum width of the image in which paint is searched [px]: far lines of a wide view
stay one pixel wide."""
_GREEN: Final = (22, 95)
"""Hues of grass in OpenCV's range of 180 [1]: yellow-green of dry grass to blue-green of flood
light."""
_MIN_HUE_SHARE: Final = 0.1
"""Hues of grass are as frequent as this share of the most frequent one [1]: mowing stripes and
shadows differ by up to 25 hues."""
_MIN_SATURATION: Final = 25
_MIN_VALUE: Final = 25
_MIN_GRASS: Final = 0.02
"""Minimum share of grass in the image [1]; below there is no pitch."""
_CLOSING: Final = 31
"""Size of gaps in the grass that belong to the pitch: people and paint [px]."""
_DIRECTIONS: Final = 12
"""Directions of ridges to try [1]: 15 degrees apart."""
_HALF_WIDTHS: Final = (3.0, 5.0, 8.0)
"""Distances between a ridge's middle and the grass on either side [px]."""
_CONTRAST: Final = (4.0, 8.0)
"""Least and greatest minimum brightness of a ridge above both sides, CIE L in 0 to 255 [1]: faded
paint has 10 to 20, thin far lines and fog 4 to 8."""
_ABOVE_NOISE: Final = 6.0
"""This minimum, in medians of all ridges [1]: nearly all are noise of the grass, of 0.5 to 4."""
_MIN_EXTENT: Final = 20
"""Minimum extent of connected ridge pixels [px]; shorter ones are noise of the grass."""
_CLUTTER: Final = (41, 0.12)
"""Size of a neighborhood [px], and share of ridges in it [1] from which they are no paint: trees,
nets, letters and people have more than the crossing of two lines."""
_ANGLES: Final = 360
"""Directions of the Hough transform [1]."""
_VOTE_SPREAD: Final = 24
"""Deviation of a vote's direction, in these directions, either way [1]: 12 degrees."""
_TOLERANCE: Final = 1.6
"""Distance of a segment's pixels from its line [px]."""
_MAX_GAP: Final = 60.0
"""Largest gap within a segment [px]: a player in front of the line."""
_MIN_LENGTH: Final = 40.0
"""Minimum length of a segment [px]."""
_MIN_FILL: Final = 0.5
"""Minimum share of a segment that is paint [1]."""
_BENDS: Final = (0.0, -0.03, -0.06, -0.09, -0.12, -0.15, -0.18, -0.22, -0.26)
"""Displacements of the left and right rim to try for a lens that is not known [1]: from a long lens
to an action camera."""
_BEND_GAIN: Final = 0.9
"""Length of straight paint, of the maximum, that suffices for no displacement [1]."""
_BEND_DOUBT: Final = 0.6
"""Length of straight paint, of the maximum, from which no displacement is tried too [1]."""
_OTHER_BENDS: Final = (1.0, 0.8, 0.65)
"""Displacements to offer for a bent image, of the one that makes the most paint straight [1]: a
single long line prefers one that is too large."""
_COMPARED_SEGMENTS: Final = 8
"""Segments whose lengths are compared [1]."""
_MIN_STRAIGHT_FOCAL: Final = 0.35
"""Minimum focal length of the straight copy, of the image's [1]: rims of very wide lenses are
cut."""
_MAX_SEGMENTS: Final = 24
"""Maximum segments [1]: a view shows up to twelve markings, some of them in pieces."""
ORIENTATIONS: Final = 6
"""Orientations of the maps of distances [1]: 30 degrees apart."""


@dataclass(frozen=True, eq=False)
class PaintMap:
    """Paint of one image, in the pixels of a straight copy: one in which lines are straight.

    Attributes:
        size: width, height of the straight copy [px].
        area: (height, width) whether the pixel belongs to the pitch.
        points: (m, 2) pixels of paint [px], straight copy.
        origins: (m, 2) the same in the image [px].
        segments: (n, 2, 2) ends of straight segments [px], the one with the most paint first.
        distances: (6, height, width) distance to the nearest paint whose normal has about the
            orientation 0, 30, ... 150 degrees [px].
        nearest: (6, height, width) index of this paint in `points`.
        lens: camera of the image without a pose; its focal length is half the width of the image
            if the lens is not known.
        focal: focal length of the straight copy for that of `lens` [px].
    """

    size: tuple[int, int]
    area: NDArray[np.bool_]
    points: Floats
    origins: Floats
    segments: Floats
    distances: NDArray[np.float32]
    nearest: NDArray[np.int32]
    lens: Camera
    focal: float


def find_paint(
    picture: Image, lens: Camera | None = None, where: str = "image"
) -> Iterator[PaintMap]:
    """Yield the paint of an image, once for every lens that it may have, the likely one first.

    Args:
        picture: (height, width, 3) RGB.
        lens: focal length, principal point and distortion of the image; None = not known. Then the
            distortion is the one that makes the most paint straight.
        where: file or camera, for messages.

    Raises:
        InputError: the image has no color or shows no grass.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise InputError(
            where,
            expected="RGB bytes of shape (height, width, 3)",
            found=f"{picture.dtype} of shape {picture.shape}",
            todo="Give a color image: the pitch is found by its color.",
        )
    width = int(np.clip(picture.shape[1], _WIDTHS[0], _WIDTHS[1]))
    scale = width / picture.shape[1]
    size = (width, max(1, round(picture.shape[0] * scale)))
    small = np.asarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC),
        dtype=np.uint8,
    )
    grass = _find_grass(small, where)
    area = _fill_area(grass)
    strength, normal = _find_ridges(small, grass, area)
    ridges = thin_ridges(strength, normal)
    original = (picture.shape[1], picture.shape[0])
    for each in (lens,) if lens is not None else _find_lenses(ridges, original, scale):
        yield straighten_paint(ridges, area, each, scale)


@dataclass(frozen=True, eq=False)
class Ridges:
    """Pixels of thin bright ridges in an image.

    Attributes:
        points: (m, 2) [px].
        normals: (m,) angles of their normals [rad].
    """

    points: Floats
    normals: Floats


def thin_ridges(strength: NDArray[np.float32], normal: Floats) -> Ridges:
    """Return the ridges of an image that are no noise.

    Args:
        strength: (height, width) contrast of ridges one pixel wide, 0 elsewhere.
        normal: (height, width) angle of the ridge's normal in [0, pi) [rad].
    """
    ridges = strength[strength > 0.0]
    noise = float(np.median(ridges)) if len(ridges) else 0.0
    thin = (strength > np.clip(_ABOVE_NOISE * noise, _CONTRAST[0], _CONTRAST[1])).astype(np.uint8)
    joined = cv2.dilate(thin, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    large = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= _MIN_EXTENT
    large[0] = False
    thin &= large[labels].astype(np.uint8)
    around, share = _CLUTTER
    crowded = cv2.boxFilter(thin, cv2.CV_32F, (around, around)) > share
    y, x = np.nonzero((thin > 0) & ~crowded)
    return Ridges(np.stack([x, y], axis=-1).astype(np.float64), normal[y, x])


def guess_lens(bend: float, image_size: tuple[int, int]) -> Camera:
    """Return a lens with a focal length of half the image's width.

    Args:
        bend: lambda of the division model, r_straight = r / (1 + lambda r^2), with radii in halves
            of the width [1].
        image_size: width, height [px].

    Note:
        Fitzgibbon 2001, "Simultaneous linear estimation of multiple view geometry and lens
        distortion".
    """
    half = 0.5 * image_size[0]
    radius = np.linspace(0.05, 1.1 * np.hypot(image_size[0], image_size[1]) / image_size[0], 40)
    straight = radius / (1.0 + bend * radius**2)
    powers = straight[:, None] ** np.array([2.0, 4.0, 6.0])
    k1, k2, k3 = np.linalg.lstsq(powers, radius / straight - 1.0, rcond=None)[0]
    return Camera(
        focal=np.array([half, half]),
        principal_point=0.5 * (np.array(image_size) - 1.0),
        distortion=np.array([k1, k2, 0.0, 0.0, k3]),
        cam_from_world=Rigid(np.eye(3), np.zeros(3)),
        image_size=np.array(image_size),
    )


def straighten_paint(
    ridges: Ridges, area: NDArray[np.bool_], lens: Camera, scale: float
) -> PaintMap:
    """Return the paint of an image in a copy without its distortion.

    Args:
        ridges: of the reduced image.
        area: (height, width) whether the pixel belongs to the pitch, in the reduced image.
        lens: of the image.
        scale: of the reduced image to the image [1].
    """
    height, width = area.shape
    flat, origins, focal = _flatten(ridges, lens, scale, (width, height))
    middle = 0.5 * np.array([width - 1, height - 1])
    y, x = np.indices((height, width), dtype=np.float64)
    rays = np.stack([x - middle[0], y - middle[1], np.full_like(x, focal)], axis=-1)
    bent = np.nan_to_num((lens.project(rays.reshape(-1, 3)) + 0.5) * scale - 0.5, nan=-1e4)
    maps = [bent[:, axis].reshape(height, width).astype(np.float32) for axis in (0, 1)]
    inside = cv2.remap(area.astype(np.uint8), maps[0], maps[1], cv2.INTER_NEAREST) > 0
    distances, nearest = _map_distances(flat, (width, height))
    segments = _find_segments(flat, float(np.hypot(width, height)), _MAX_SEGMENTS)
    return PaintMap(
        (width, height),
        np.asarray(inside),
        flat.points,
        origins,
        np.array([ends for _, ends in segments]).reshape(-1, 2, 2),
        distances,
        nearest,
        lens,
        focal,
    )


def _flatten(
    ridges: Ridges, lens: Camera, scale: float, size: tuple[int, int]
) -> tuple[Ridges, Floats, float]:
    """Return ridges in the straight copy, their pixels (m, 2) in the image, its focal length.

    Args:
        ridges: of the reduced image.
        lens: of the image.
        scale: of the reduced image to the image [1].
        size: width, height of the reduced image and of the straight copy [px].
    """
    width, height = size
    middle = 0.5 * np.array([width - 1, height - 1])
    origins = (ridges.points + 0.5) / scale - 0.5
    rim = np.array([[0.0, 0.5], [1.0, 0.5]]) * (lens.image_size - 1)
    reach = float(np.abs(lens.normalize(rim)[:, 0]).max())
    reduced = float(lens.focal[0]) * scale
    focal = 0.5 * width / reach if np.isfinite(reach) else 0.0
    focal = float(np.clip(focal, _MIN_STRAIGHT_FOCAL * reduced, reduced))
    # A second place tells how the direction of a ridge turns.
    along = np.stack([-np.sin(ridges.normals), np.cos(ridges.normals)], axis=-1)
    flat, stepped = (
        lens.normalize(places) * focal + middle for places in (origins, origins + along)
    )
    kept = np.isfinite(flat).all(axis=1) & np.isfinite(stepped).all(axis=1)
    kept &= (flat >= 0.0).all(axis=1) & (flat <= [width - 1, height - 1]).all(axis=1)
    flat, step = flat[kept], (stepped - flat)[kept]
    normals = (np.arctan2(step[:, 1], step[:, 0]) + 0.5 * np.pi) % np.pi
    return Ridges(flat, normals), origins[kept], focal


def _find_lenses(ridges: Ridges, image_size: tuple[int, int], scale: float) -> tuple[Camera, ...]:
    """Return lenses that make the most paint straight; one without distortion if it does."""
    size = (round(image_size[0] * scale), max(1, round(image_size[1] * scale)))
    straight = []
    for bend in _BENDS:
        flat = _flatten(ridges, guess_lens(bend, image_size), scale, size)[0]
        segments = _find_segments(flat, float(np.hypot(size[0], size[1])), _COMPARED_SEGMENTS)
        straight.append(sum(count for count, _ in segments))
    straightest = guess_lens(0.0, image_size)
    if straight[0] >= _BEND_GAIN * max(straight):
        return (straightest,)
    best = _BENDS[int(np.argmax(straight))]
    bent = tuple(guess_lens(share * best, image_size) for share in _OTHER_BENDS)
    # A lens that bends a circle straight gains paint too.
    return (straightest, *bent) if straight[0] >= _BEND_DOUBT * max(straight) else bent


def _map_distances(
    ridges: Ridges, size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the distances and the nearest points of `PaintMap`."""
    width, height = size
    distances = np.full((ORIENTATIONS, height, width), np.inf, np.float32)
    nearest = np.zeros((ORIENTATIONS, height, width), np.int32)
    step = np.pi / ORIENTATIONS
    x, y = np.round(ridges.points).astype(np.int64).T
    for index in range(ORIENTATIONS):
        mine = np.flatnonzero(_angle_between(ridges.normals, index * step) < 0.9 * step)
        if not len(mine):
            continue
        free = np.ones((height, width), np.uint8)
        free[y[mine], x[mine]] = 0
        distances[index], labels = cv2.distanceTransformWithLabels(
            free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        places = np.zeros(int(labels.max()) + 1, np.int32)
        places[labels[y[mine], x[mine]]] = mine
        nearest[index] = places[labels]
    return distances, nearest


def _find_grass(picture: Image, where: str) -> NDArray[np.bool_]:
    """Return the mask (height, width) of pixels with the hue of the grass.

    Raises:
        InputError: there is no grass.
    """
    hue, saturation, value = np.moveaxis(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV), -1, 0)
    green = (hue > _GREEN[0]) & (hue < _GREEN[1])
    green &= (saturation > _MIN_SATURATION) & (value > _MIN_VALUE)
    lower = green.copy()
    lower[: len(lower) // 4] = False
    if np.count_nonzero(lower) < _MIN_GRASS * lower.size:
        raise InputError(
            where,
            expected="grass in the lower three quarters of the image",
            found=f"{np.count_nonzero(lower) / lower.size:.1%} of green pixels",
            todo="Use an image of the pitch in color.",
        )
    counts = np.bincount(hue[lower], minlength=180).astype(np.float64)
    counts = np.convolve(counts, np.ones(7), mode="same")
    rare = np.flatnonzero(counts < _MIN_HUE_SHARE * counts.max())
    peak = int(counts.argmax())
    first = max(_GREEN[0], int(rare[rare < peak].max(initial=-1)) + 1)
    last = min(_GREEN[1], int(rare[rare > peak].min(initial=180)) - 1)
    return np.asarray(green & (hue >= first) & (hue <= last))


def _fill_area(grass: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest area (height, width) of grass, without the holes of people and paint."""
    mask = cv2.morphologyEx(grass.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSING, _CLOSING))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    if len(stats) < 2:
        return np.zeros(grass.shape, np.bool_)
    area = np.asarray(labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~area).astype(np.uint8))
    height, width = grass.shape
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    inside = (left > 0) & (left + stats[:, cv2.CC_STAT_WIDTH] < width)
    inside &= (top > 0) & (top + stats[:, cv2.CC_STAT_HEIGHT] < height)
    inside[0] = False
    return np.asarray(area | inside[labels])


def _find_ridges(
    picture: Image, grass: NDArray[np.bool_], area: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], Floats]:
    """Return contrasts (height, width) of ridges one pixel wide, and angles of normals [rad]."""
    lightness = _smooth_lightness(picture)
    green = np.asarray(cv2.GaussianBlur(grass.astype(np.float32), (0, 0), 1.5), dtype=np.float32)
    best = np.zeros(lightness.shape, np.float32)
    angle = np.zeros(lightness.shape)
    for theta in np.arange(_DIRECTIONS) * (np.pi / _DIRECTIONS):
        normal = np.array([np.cos(theta), np.sin(theta)])
        along = np.array([-normal[1], normal[0]])
        for half in _HALF_WIDTHS:
            left, right = (_shift(lightness, way * half * normal) for way in (1.0, -1.0))
            one, other = (_shift(green, way * (half + 1.0) * normal) for way in (1.0, -1.0))
            contrast: NDArray[np.float32] = np.asarray(
                lightness - np.maximum(left, right), np.float32
            )
            contrast[np.minimum(one, other) < 0.5] = 0.0
            contrast += _shift(contrast, 3.0 * along) + _shift(contrast, -3.0 * along)
            contrast /= 3.0
            better = contrast > best
            best[better], angle[better] = contrast[better], theta
    best[~area] = 0.0
    smooth = np.asarray(cv2.GaussianBlur(best, (0, 0), 1.0), dtype=np.float32)
    y, x = np.indices(best.shape, dtype=np.float32)
    highest = best > 0.0
    for way in (1.2, -1.2, 2.4, -2.4):
        there = cv2.remap(
            smooth,
            (x + way * np.cos(angle)).astype(np.float32),
            (y + way * np.sin(angle)).astype(np.float32),
            cv2.INTER_LINEAR,
        )
        highest &= smooth >= there
    return np.where(highest, best, np.float32(0.0)), angle


def _smooth_lightness(picture: Image) -> NDArray[np.float32]:
    """Return the blurred CIE L (height, width) of an RGB image, in 0 to 255."""
    lightness = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)[..., 0], dtype=np.float32)
    return np.asarray(cv2.GaussianBlur(lightness, (0, 0), 0.8), dtype=np.float32)


def _shift(values: NDArray[np.float32], by: Floats) -> NDArray[np.float32]:
    """Return the values (height, width) at a displacement (2,) of every pixel [px]."""
    height, width = values.shape
    matrix = np.array([[1.0, 0.0, by[0]], [0.0, 1.0, by[1]]], np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(
        values, matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(moved, dtype=np.float32)


def _angle_between(angles: Floats, other: float) -> Floats:
    """Return angles (...) between undirected lines, in [0, pi / 2] [rad]."""
    return np.abs((angles - other + 0.5 * np.pi) % np.pi - 0.5 * np.pi)


def _find_segments(ridges: Ridges, diagonal: float, most: int) -> list[tuple[int, Floats]]:
    """Return pixels of paint and ends (2, 2) [px] of segments, the one with the most paint first.

    Args:
        ridges: pixels and normals.
        diagonal: of the image [px].
        most: maximum segments [1].
    """
    points, angles = ridges.points, ridges.normals
    thetas, columns = np.arange(_ANGLES) * (np.pi / _ANGLES), int(diagonal) + 2
    segments: list[tuple[int, Floats]] = []
    for _ in range(3 * most):
        if len(points) < _MIN_LENGTH or len(segments) >= most:
            break
        own = np.round(angles / np.pi * _ANGLES).astype(np.int64)[:, None]
        index = (own + np.arange(-_VOTE_SPREAD, _VOTE_SPREAD + 1)) % _ANGLES
        offset = points[:, :1] * np.cos(thetas[index]) + points[:, 1:] * np.sin(thetas[index])
        bins = index * columns + (0.5 * (offset + diagonal)).astype(np.int64)
        votes = np.bincount(bins.ravel(), minlength=_ANGLES * columns).reshape(_ANGLES, columns)
        votes = votes + np.roll(votes, 1, axis=1)
        row, column = np.unravel_index(int(votes.argmax()), votes.shape)
        if votes[row, column] < _MIN_LENGTH * _MIN_FILL:
            break
        voted = np.array([np.cos(thetas[row]), np.sin(thetas[row])])
        middle = 2.0 * column - diagonal
        near, across, offset = _fit_line(points, angles, voted, middle)
        segments += _split(points[near], across, offset)
        # The voters go too where they form no line; else they would win again.
        gone = np.abs(points @ across - offset) < 2.0 * _TOLERANCE
        gone |= np.abs(points @ voted - middle) < 2.0 * _TOLERANCE
        gone &= _angle_between(angles, np.arctan2(voted[1], voted[0])) < 0.5
        if not gone.any():
            break
        points, angles = points[~gone], angles[~gone]
    return sorted(segments, key=lambda each: -each[0])[:most]


def _fit_line(
    points: Floats, angles: Floats, across: Floats, offset: float
) -> tuple[NDArray[np.bool_], Floats, float]:
    """Return the mask of a line's pixels, its normal (2,) and its offset [px]."""
    near = np.zeros(len(points), np.bool_)
    for tolerance in (
        3.0 * _TOLERANCE,
        2.0 * _TOLERANCE,
        1.5 * _TOLERANCE,
        _TOLERANCE,
    ):
        turned = _angle_between(angles, np.arctan2(across[1], across[0]))
        near = (np.abs(points @ across - offset) < tolerance) & (turned < 0.3)
        if np.count_nonzero(near) < 10:
            break
        middle = points[near].mean(axis=0)
        fitted = np.linalg.svd(points[near] - middle, full_matrices=False)[2][1]
        across = fitted if fitted @ across > 0.0 else -fitted
        offset = float(middle @ across)
    return near, across, offset


def _split(points: Floats, across: Floats, offset: float) -> list[tuple[int, Floats]]:
    """Return pixels of paint and ends (2, 2) of the line's segments that are long and filled."""
    along = np.array([-across[1], across[0]])
    places = np.sort(points @ along)
    if not len(places):
        return []
    gaps = np.flatnonzero(np.diff(places) > _MAX_GAP)
    starts, stops = np.append(0, gaps + 1), np.append(gaps, len(places) - 1)
    segments = []
    for start, stop in zip(starts, stops, strict=True):
        length = places[stop] - places[start]
        count = int(stop - start + 1)
        if length > _MIN_LENGTH and count > _MIN_FILL * length:
            segments.append((count, across * offset + np.outer(places[[start, stop]], along)))
    return segments


_TRACE_REACH: Final = 0.004
"""Largest distance of thin paint from its projection, in image widths [1]."""
_TRACE_SPACING: Final = 8.0
"""Distance of neighboring cross sections [px]: errors of paint are correlated over as much."""
_TRACE_STEP: Final = 0.5
"""Step along a cross section [px]."""
_TRACE_CONTRAST: Final = 6.0
"""Minimum brightness of thin paint above both sides [levels of 255], as of painted lines."""
_TRACE_TOLERANCE: Final = 1.0
"""Largest distance of a ridge from the curve of its marking [px]."""
_TRACE_SHARE: Final = 0.4
"""Minimum share of the cross sections with the ridge on the curve [1], as of painted lines."""
_TRACE_MIN: Final = 15
"""Minimum number of such cross sections [1]: fewer lie on a curve by chance."""
_TRACE_RIVAL: Final = 0.75
"""Maximum number of cross sections of any other curve, of those of the best one [1]."""
_TRACE_TRIALS: Final = 400
"""Curves through three random ridges to try [1]."""


def trace_marking(picture: Image, pixels: Floats) -> Floats:
    """Return pixels (n, 2) on thin paint along a projected marking; none if there is no clear one.

    The paint of a far line is thinner than a pixel and a few pixels away from its projection, among
    letters, boards and people. The ridge that follows one smooth curve is the paint.

    Args:
        picture: (height, width, 3) RGB.
        pixels: (m, 2) projected points along the marking in order [px]; NaN where not visible.
    """
    height, width = picture.shape[:2]
    inside = ((pixels >= 0.0) & (pixels <= [width - 1.0, height - 1.0])).all(axis=1)
    pixels = pixels[inside]
    if len(pixels) < 2:
        return np.zeros((0, 2))
    lengths = np.append(0.0, np.linalg.norm(np.diff(pixels, axis=0), axis=1).cumsum())
    places = np.arange(0.0, lengths[-1], _TRACE_SPACING)
    if len(places) < _TRACE_MIN:
        return np.zeros((0, 2))
    at = np.stack([np.interp(places, lengths, pixels[:, axis]) for axis in (0, 1)], axis=1)
    along = np.gradient(at, axis=0)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    row, ridge = _find_section_ridges(picture, at, normals)
    if len(np.unique(row)) < _TRACE_MIN:
        return np.zeros((0, 2))
    share = row / max(1, len(places) - 1)
    on = _follow_curve(row, share, ridge)
    if len(np.unique(row[on])) < max(_TRACE_MIN, _TRACE_SHARE * len(places)):
        return np.zeros((0, 2))
    others = ~np.isin(row, row[on]) | (np.abs(ridge - _curve(share[on], ridge[on], share)) > 3.0)
    rival = _follow_curve(row[others], share[others], ridge[others])
    if len(np.unique(row[others][rival])) > _TRACE_RIVAL * len(np.unique(row[on])):
        return np.zeros((0, 2))
    return np.asarray(at[row[on]] + ridge[on, None] * normals[row[on]])


def _find_section_ridges(picture: Image, at: Floats, normals: Floats) -> tuple[Integers, Floats]:
    """Return the cross sections (k,) of ridges, and the ridges' offsets (k,) in them [px].

    Args:
        picture: (height, width, 3) RGB.
        at: (n, 2) middles of the cross sections [px].
        normals: (n, 2) their directions.
    """
    reach = _TRACE_REACH * picture.shape[1]
    offsets = np.arange(-reach, reach + _TRACE_STEP, _TRACE_STEP)
    pixels = (at[:, None] + offsets[:, None] * normals[:, None]).astype(np.float32)
    profiles = cv2.remap(
        _smooth_lightness(picture), pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR
    )
    side = round(2.0 / _TRACE_STEP)
    flanks = np.maximum(profiles[:, : -2 * side], profiles[:, 2 * side :])
    contrast = profiles[:, side:-side] - flanks
    peak = contrast >= _TRACE_CONTRAST
    peak[:, 1:] &= contrast[:, 1:] >= contrast[:, :-1]
    peak[:, :-1] &= contrast[:, :-1] > contrast[:, 1:]
    row, column = np.nonzero(peak)
    return row, offsets[side:-side][column]


def _follow_curve(row: Integers, share: Floats, ridge: Floats) -> NDArray[np.bool_]:
    """Return which ridges (n,) lie on the parabola that passes most cross sections' ridges."""
    best = np.zeros(len(row), np.bool_)
    if len(np.unique(row)) < 3:
        return best
    rng = np.random.default_rng(0)
    for _ in range(_TRACE_TRIALS):
        chosen = rng.choice(len(row), 3, replace=False)
        if np.ptp(share[chosen]) < 0.3 or len(np.unique(row[chosen])) < 3:
            continue
        on = np.abs(ridge - _curve(share[chosen], ridge[chosen], share)) < _TRACE_TOLERANCE
        if len(np.unique(row[on])) > len(np.unique(row[best])):
            best = on
    for _ in range(3 if best.any() else 0):
        best = np.abs(ridge - _curve(share[best], ridge[best], share)) < _TRACE_TOLERANCE
    return best


def _curve(share: Floats, ridge: Floats, at: Floats) -> Floats:
    """Return the parabola through given places, at other places."""
    powers = np.arange(3)
    fitted = np.linalg.lstsq(share[:, None] ** powers, ridge, rcond=None)[0]
    return np.asarray(at[:, None] ** powers @ fitted)
