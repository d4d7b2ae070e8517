"""Painted lines of an image whose camera is unknown: thin bright ridges on the pitch.

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

from data_contracts.arrays import Flags, Floats, Image, Singles
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

_TOLERANCE: Final = 1.6
"""Distance of a segment's pixels from its line [px]."""
_MIN_LENGTH: Final = 40.0
"""Minimum length of a segment [px]."""
_MIN_FILL: Final = 0.5
"""Minimum share of a segment that is paint [1]."""
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
    area: Flags
    points: Floats
    origins: Floats
    segments: Floats
    distances: Singles
    nearest: NDArray[np.int32]
    lens: Camera
    focal: float


def find_paint(
    picture: Image, lens: Camera | None = None, where: str = "image"
) -> Iterator[PaintMap]:
    """Yield the paint of an image, once for every lens that it may have, the likely one first.

    `picture` (height, width, 3) is RGB. Without the lens, the distortion is the one that makes the
    most paint straight. InputError, with `where`, if the image has no color or shows no grass.
    """
    widths = (1280, 1920)  # far lines of a wide view stay one pixel wide
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise InputError(
            where,
            expected="RGB bytes of shape (height, width, 3)",
            found=f"{picture.dtype} of shape {picture.shape}",
            todo="Give a color image: the pitch is found by its color.",
        )
    width = int(np.clip(picture.shape[1], widths[0], widths[1]))
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


def restore_colors(picture: Image) -> Image:
    """Return an RGB image (height, width, 3) whose paint is white and bright.

    Paint is the brightest thing beside grass, and it has no color: the gain of each channel makes
    the brightest pixels white. So casts of lamps or cameras go, and haze and dull light.
    """
    lower = picture[len(picture) // 4 :]  # without sky and stands
    # Haze is part of what the darkest 1 % have. Paint covers 0.5 % of a wide view; 245 of 255
    # leaves room for what is brighter.
    dark = 0.7 * float(np.percentile(lower.min(axis=2), 1.0))
    gain = 245.0 / np.maximum(np.percentile(lower, 99.5, axis=(0, 1)) - dark, 1.0)
    table = np.clip((np.arange(256.0)[:, None] - dark) * gain, 0.0, 255.0)
    return np.asarray(cv2.LUT(picture, np.round(table).astype(np.uint8)[:, None]), np.uint8)


@dataclass(frozen=True, eq=False)
class Ridges:
    """Pixels of thin bright ridges in an image.

    Attributes:
        points: (m, 2) [px].
        normals: (m,) angles of their normals [rad].
    """

    points: Floats
    normals: Floats


def thin_ridges(strength: Singles, normal: Floats) -> Ridges:
    """Return the ridges of an image that are no noise.

    The strength (height, width) is the contrast of ridges one pixel wide, 0 elsewhere; normals
    (height, width) are angles in [0, pi) [rad].
    """
    contrast = (4.0, 8.0)  # of CIE L: faded paint has 10 to 20, thin far lines and fog 4 to 8
    ridges = strength[strength > 0.0]
    noise = float(np.median(ridges)) if len(ridges) else 0.0
    # Nearly all ridges are noise of the grass, of 0.5 to 4.
    thin = (strength > np.clip(6.0 * noise, contrast[0], contrast[1])).astype(np.uint8)
    joined = cv2.dilate(thin, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    # Shorter ones are noise of the grass.
    large = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= 20
    large[0] = False
    thin &= large[labels].astype(np.uint8)
    # Trees, nets, letters and people have more ridges than the crossing of two lines.
    around, share = (41, 0.12)
    crowded = cv2.boxFilter(thin, cv2.CV_32F, (around, around)) > share
    y, x = np.nonzero((thin > 0) & ~crowded)
    return Ridges(np.stack([x, y], axis=-1).astype(np.float64), normal[y, x])


def guess_lens(bend: float, image_size: tuple[int, int]) -> Camera:
    """Return a lens with a focal length of half the width of an image of a width and height [px].

    The bend is lambda of the division model, r_straight = r / (1 + lambda r^2), with radii in
    halves of the width [1] (Fitzgibbon 2001, "Simultaneous linear estimation of multiple view
    geometry and lens distortion").
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


def straighten_paint(ridges: Ridges, area: Flags, lens: Camera, scale: float) -> PaintMap:
    """Return the paint of an image in a copy without its distortion.

    The ridges and the area (height, width) are of a reduced image, at a scale [1] of the image.
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
    # A view shows up to twelve markings, some of them in pieces.
    segments = _find_segments(flat, float(np.hypot(width, height)), 24)
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
    """Return ridges in the straight copy, their pixels (m, 2) in the image, its focal length."""
    width, height = size
    middle = 0.5 * np.array([width - 1, height - 1])
    origins = (ridges.points + 0.5) / scale - 0.5
    rim = np.array([[0.0, 0.5], [1.0, 0.5]]) * (lens.image_size - 1)
    reach = float(np.abs(lens.normalize(rim)[:, 0]).max())
    reduced = float(lens.focal[0]) * scale
    focal = 0.5 * width / reach if np.isfinite(reach) else 0.0
    # Rims of very wide lenses are cut.
    focal = float(np.clip(focal, 0.35 * reduced, reduced))
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
    # Displacements of the left and right rim: from a long lens to an action camera.
    bends = (0.0, -0.03, -0.06, -0.09, -0.12, -0.15, -0.18, -0.22, -0.26)
    size = (round(image_size[0] * scale), max(1, round(image_size[1] * scale)))
    straight = []
    for bend in bends:
        flat = _flatten(ridges, guess_lens(bend, image_size), scale, size)[0]
        segments = _find_segments(flat, float(np.hypot(size[0], size[1])), 8)
        straight.append(sum(count for count, _ in segments))
    straightest = guess_lens(0.0, image_size)
    # No bend is likely if it makes nearly as much paint straight as the best one.
    if straight[0] >= 0.9 * max(straight):
        return (straightest,)
    best = bends[int(np.argmax(straight))]
    # A single long line prefers a bend that is too large.
    bent = tuple(guess_lens(share * best, image_size) for share in (1.0, 0.8, 0.65))
    # A lens that bends a circle straight gains paint too.
    return (straightest, *bent) if straight[0] >= 0.6 * max(straight) else bent


def _map_distances(ridges: Ridges, size: tuple[int, int]) -> tuple[Singles, NDArray[np.int32]]:
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


def _find_grass(picture: Image, where: str) -> Flags:
    """Return the mask (height, width) of pixels with the hue of the grass."""
    hues = (22, 95)  # yellow-green of dry grass to blue-green of flood light
    hue, saturation, value = np.moveaxis(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV), -1, 0)
    green = (hue > hues[0]) & (hue < hues[1])
    green &= (saturation > 25) & (value > 25)
    lower = green.copy()
    lower[: len(lower) // 4] = False
    if np.count_nonzero(lower) < 0.02 * lower.size:
        raise InputError(
            where,
            expected="grass in the lower three quarters of the image",
            found=f"{np.count_nonzero(lower) / lower.size:.1%} of green pixels",
            todo="Use an image of the pitch in color; on another floor, click its markings.",
        )
    counts = np.bincount(hue[lower], minlength=180).astype(np.float64)
    counts = np.convolve(counts, np.ones(7), mode="same")
    # Mowing stripes and shadows differ by up to 25 hues.
    rare = np.flatnonzero(counts < 0.1 * counts.max())
    peak = int(counts.argmax())
    first = max(hues[0], int(rare[rare < peak].max(initial=-1)) + 1)
    last = min(hues[1], int(rare[rare > peak].min(initial=180)) - 1)
    return np.asarray(green & (hue >= first) & (hue <= last))


def _fill_area(grass: Flags) -> Flags:
    """Return the largest area (height, width) of grass, without the holes of people and paint."""
    gap = 31  # people and paint in the grass [px]
    mask = cv2.morphologyEx(grass.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (gap, gap))
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


def _find_ridges(picture: Image, grass: Flags, area: Flags) -> tuple[Singles, Floats]:
    """Return contrasts (height, width) of ridges one pixel wide, and angles of normals [rad]."""
    directions = 12  # 15 degrees apart
    lightness = smooth_lightness(picture)
    green = np.asarray(cv2.GaussianBlur(grass.astype(np.float32), (0, 0), 1.5), dtype=np.float32)
    best = np.zeros(lightness.shape, np.float32)
    angle = np.zeros(lightness.shape)
    for theta in np.arange(directions) * (np.pi / directions):
        normal = np.array([np.cos(theta), np.sin(theta)])
        along = np.array([-normal[1], normal[0]])
        for half in (3.0, 5.0, 8.0):
            left, right = (_shift(lightness, way * half * normal) for way in (1.0, -1.0))
            one, other = (_shift(green, way * (half + 1.0) * normal) for way in (1.0, -1.0))
            contrast: Singles = np.asarray(lightness - np.maximum(left, right), np.float32)
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


def smooth_lightness(picture: Image) -> Singles:
    """Return the blurred CIE L (height, width) of an RGB image, in 0 to 255."""
    lightness = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)[..., 0], dtype=np.float32)
    return np.asarray(cv2.GaussianBlur(lightness, (0, 0), 0.8), dtype=np.float32)


def _shift(values: Singles, by: Floats) -> Singles:
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
    """Return pixels of paint and ends (2, 2) [px] of segments, those with the most paint first."""
    vote_spread = 24  # 12 degrees
    count = 360
    points, angles = ridges.points, ridges.normals
    thetas, columns = np.arange(count) * (np.pi / count), int(diagonal) + 2
    segments: list[tuple[int, Floats]] = []
    for _ in range(3 * most):
        if len(points) < _MIN_LENGTH or len(segments) >= most:
            break
        own = np.round(angles / np.pi * count).astype(np.int64)[:, None]
        index = (own + np.arange(-vote_spread, vote_spread + 1)) % count
        offset = points[:, :1] * np.cos(thetas[index]) + points[:, 1:] * np.sin(thetas[index])
        bins = index * columns + (0.5 * (offset + diagonal)).astype(np.int64)
        votes = np.bincount(bins.ravel(), minlength=count * columns).reshape(count, columns)
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
) -> tuple[Flags, Floats, float]:
    """Return the mask of a line's pixels, its normal (2,) and its offset [px]."""
    near = np.zeros(len(points), np.bool_)
    for tolerance in (3.0 * _TOLERANCE, 2.0 * _TOLERANCE, 1.5 * _TOLERANCE, _TOLERANCE):
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
    # A player in front of the line.
    gaps = np.flatnonzero(np.diff(places) > 60.0)
    starts, stops = np.append(0, gaps + 1), np.append(gaps, len(places) - 1)
    segments = []
    for start, stop in zip(starts, stops, strict=True):
        length = places[stop] - places[start]
        count = int(stop - start + 1)
        if length > _MIN_LENGTH and count > _MIN_FILL * length:
            segments.append((count, across * offset + np.outer(places[[start, stop]], along)))
    return segments
