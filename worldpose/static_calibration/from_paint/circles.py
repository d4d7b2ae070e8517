"""Candidate cameras from a segment of paint and the circle around it.

Where the centre circle, or the arc of a penalty area, is in view, one straight marking next to it
determines a camera without roll: midfield shows no three straight markings. On the ground the
normal of a circle passes through its centre, so that every pixel of paint votes for one circle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from data_contracts.arrays import Floats
from worldpose.pitch.template import PitchTemplate
from worldpose.static_calibration.from_paint.candidates import (
    SEGMENTS,
    TILTS,
    Candidates,
    are_plausible,
    level_cameras,
    straight_lines,
    turn_about_axis,
)
from worldpose.static_calibration.from_paint.paint import PaintMap


class _PaintedArc(NamedTuple):
    """A circle, and a straight marking that crosses, bounds or passes it.

    Attributes:
        axis: along which the marking runs: 0 = x, 1 = y.
        line: place of the marking on the other axis [m].
        center: place of the circle's centre on this axis [m].
        depth: distance of the centre from the marking, positive on the arc's side, in radii [1].
        ways: which parts of the arc are in view, 1 = beyond the centre, -1 = before it.
        radius: of the circle [m].
        side: of the marking on which the arc lies, on the other axis [1]; 0 = on both.
    """

    axis: int
    line: float
    center: float
    depth: float
    ways: tuple[float, ...]
    radius: float
    side: float


def _painted_arcs(pitch: PitchTemplate) -> list[_PaintedArc]:
    """Return circles with the lines that they cross or that bound them, and with touch lines.

    Those that half a turn makes equal to others are left out.
    """
    found = []
    x_lines, y_lines = (np.unique(lines[:, 0]) for lines in straight_lines(pitch))
    for name, arc in pitch.arcs.items():
        x, y = pitch.points[arc.center][:2].tolist()
        # A surveyed centre mark lies millimetres off the middle.
        if x > arc.radius or arc.radius < 3.0:
            continue
        places = pitch.marking_points(name, 0.25)[:, 0]
        for line in y_lines.tolist():
            beyond = places - line
            if abs(x - line) > 0.8 * arc.radius or np.abs(beyond).min() > 0.3:
                continue
            crossed = beyond.min() < -1.0 and beyond.max() > 1.0
            side = 0.0 if crossed else float(np.sign(beyond[np.abs(beyond).argmax()]))
            depth = -abs(x - line) / arc.radius
            found.append(_PaintedArc(1, line, y, depth, (1.0,), arc.radius, side))
        if name == "center_circle":
            line = float(x_lines.max())
            depth = (line - y) / arc.radius
            found.append(_PaintedArc(0, line, x, depth, (1.0, -1.0), arc.radius, -1.0))
    return found


def name_circles(paint: PaintMap, pitch: PitchTemplate, focals: Floats, roll: float) -> Candidates:
    """Return the cameras with a roll of all segments with a circle of paint around them.

    On the ground the normal of a circle passes through its centre. A pixel's distance from the
    segment and its normal give radius and centre of the one circle for which it votes.
    """
    rows, counts = [np.empty((0, 9))], [np.zeros(0)]
    for seen in _ground_paint(paint, focals, roll):
        across = np.stack([seen.along[:, 1], -seen.along[:, 0]], axis=-1)
        for arc in _painted_arcs(pitch):
            for sign in (1.0, -1.0) if arc.side else (0.0,):
                radius, center, count = _vote_circle(seen, arc, sign)
                height = arc.radius / radius
                # Arcs lie on one side of their line: the frame may have to be turned.
                turn = sign * arc.side if arc.side else 1.0
                turn, normal_sign = (-turn, -1.0) if arc.axis == 0 else (turn, 1.0)
                across_place = arc.line - normal_sign * turn * height * seen.offset
                along_place = arc.center - turn * height * center
                x, y = (across_place, along_place) if arc.axis else (along_place, across_place)
                axes = (turn * across, turn * seen.along)
                axes = axes if arc.axis else (turn * seen.along, -turn * across)
                # Minimum share of the paint on a circle.
                fits = (count >= 0.01) & are_plausible(pitch, height, x, y)
                rows.append(np.column_stack([seen.focals, seen.tilts, height, *axes, x, y])[fits])
                counts.append(count[fits])
    best = np.argsort(-np.concatenate(counts), kind="stable")[:400]
    level = level_cameras(np.concatenate(rows)[best])
    return replace(level, rotations=turn_about_axis(roll) @ level.rotations)


class _Paint(NamedTuple):
    """Pixels of paint around a segment, in the ground frame of level cameras.

    Attributes:
        focals: (g,) [px].
        tilts: (g,) [rad].
        along: (g, 2) unit vector of the segment.
        offset: (g,) of the segment across it, to its right [1].
        places: (g, m, 2) of the pixels to the right of the segment and along it [1].
        normals: (g, m, 2) unit normals of the paint, in the same axes.
    """

    focals: Floats
    tilts: Floats
    along: Floats
    offset: Floats
    places: Floats
    normals: Floats


def _ground_paint(paint: PaintMap, focals: Floats, roll: float) -> Iterator[_Paint]:
    """Yield the paint around each segment at all focal lengths and tilts."""
    middle = 0.5 * np.array([paint.size[0] - 1, paint.size[1] - 1])
    points, ways = _paint_directions(paint.points)
    if not len(points):
        return
    level = turn_about_axis(roll)[:2, :2]
    ends = ((paint.segments[:SEGMENTS] - middle) @ level).reshape(-1, 2)
    start = (points - middle) @ level
    focal, tilt = (
        part.ravel() for part in np.meshgrid(focals * paint.size[0], TILTS, indexing="ij")
    )
    lines, places, beyond = (
        _to_ground(pixels, focal, tilt) for pixels in (ends, start, start + ways @ level)
    )
    lines = lines.reshape(len(focal), -1, 2, 2)
    way = beyond - places
    normals = np.stack([-way[..., 1], way[..., 0]], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    for index in range(lines.shape[1]):
        along = lines[:, index, 1] - lines[:, index, 0]
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        kept = np.isfinite(along).all(axis=-1)
        axes = np.stack([along[:, ::-1] * [1.0, -1.0], along], axis=-1)[kept]
        offset = (lines[kept, index].mean(axis=1) * axes[..., 0]).sum(axis=-1)
        relative = places[kept] @ axes - np.stack([offset, np.zeros_like(offset)], axis=-1)[:, None]
        yield _Paint(focal[kept], tilt[kept], along[kept], offset, relative, normals[kept] @ axes)


def _to_ground(pixels: Floats, focal: Floats, tilt: Floats) -> Floats:
    """Return places (g, n, 2) on the ground, right and forward; NaN above the horizon."""
    cosine, sine, away = np.cos(tilt)[:, None], np.sin(tilt)[:, None], focal[:, None]
    depth = pixels[:, 1] * cosine + away * sine
    depth = np.where(depth > 1e-3 * away, depth, np.nan)
    return np.stack([pixels[:, 0] / depth, (away * cosine - pixels[:, 1] * sine) / depth], axis=-1)


def _paint_directions(paint: Floats) -> tuple[Floats, Floats]:
    """Return some pixels of paint (m, 2), and unit vectors (m, 2) along it."""
    points = paint[:: max(1, len(paint) // 1200)]
    if not len(points):
        return points, points
    distance, index = cKDTree(paint).query(points, k=16, distance_upper_bound=14.0)
    near = np.isfinite(distance)
    count = near.sum(axis=1)
    around = np.where(near[..., None], paint[np.minimum(index, len(paint) - 1)], 0.0)
    mean = around.sum(axis=1) / count[:, None]
    off = np.where(near[..., None], around - mean[:, None], 0.0)
    spread, axes = np.linalg.eigh(np.einsum("mki,mkj->mij", off, off))
    clear = (count >= 8) & (spread[:, 1] > 20.0 * spread[:, 0])
    return mean[clear], axes[clear][:, :, 1]


def _vote_circle(seen: _Paint, arc: _PaintedArc, sign: float) -> tuple[Floats, Floats, Floats]:
    """Return radius, centre along the segment and share of votes (g,) of the best circle.

    The sign is the side of the paint, 0 = both.
    """
    reach = (0.1, 5.0)  # radii to vote for, in heights of the camera
    bins = (0.08, 0.15, 160)  # log radius, center along the line in radii, number of these
    across, along, normal_across, normal_along = np.moveaxis(
        np.concatenate([seen.places, seen.normals], axis=-1), -1, 0
    )
    rows = int(np.log(reach[1] / reach[0]) / bins[0]) + 1
    cells = rows * bins[2]
    counts = np.zeros(len(across) * cells, np.int64)
    for way in arc.ways:
        steep = arc.depth + way * np.abs(normal_across)
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = np.abs(across) / steep
            used = (steep > 0.2) & (radius > reach[0]) & (radius < reach[1])
            if sign:
                used &= across * sign > 0.0
        g, m = np.nonzero(used)
        found = radius[g, m]
        toward = way * np.sign(across[g, m]) * np.sign(normal_across[g, m])
        column = (along[g, m] / found - toward * normal_along[g, m]) / bins[1] + 0.5 * bins[2]
        row = np.log(found / reach[0]) / bins[0]
        kept = (column >= 0.0) & (column < bins[2])
        cell = row[kept].astype(np.int64) * bins[2] + column[kept].astype(np.int64)
        counts += np.bincount(g[kept] * cells + cell, minlength=len(counts))
    votes = counts.reshape(-1, cells)
    best = votes.argmax(axis=1)
    size = reach[0] * np.exp((best // bins[2] + 0.5) * bins[0])
    place = (best % bins[2] + 0.5 - 0.5 * bins[2]) * bins[1] * size
    return size, place, votes.max(axis=1) / max(1, across.shape[1])
