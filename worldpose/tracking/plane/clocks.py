"""Clock offsets of cameras, from people who run in the view of two cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Final

import numpy as np
from scipy.sparse.csgraph import connected_components

from data_contracts.arrays import Flags, Floats
from worldpose.tracking.plane.feet import GroundPositions
from worldpose.tracking.plane.tracker import GroundTracks, track_on_plane

MIN_RUNNERS: Final = 3
"""Least pairs of tracks that determine a clock offset [1]."""


@dataclass(frozen=True, eq=False)
class PlaneClocks:
    """Clock offsets of cameras, by the people that they see on the plane.

    Attributes:
        seconds: (cameras,) time of each camera's image minus the time of its frame [s], relative to
            the mean of its group; 0 where not determined.
        std: (cameras,) standard deviation [s]; infinite where not determined.
        people: pairs of tracks that tell the offsets.
        runs: (cameras,), whether the camera sees enough people run. Standing people have the same
            places at all offsets.
        groups: cameras that share runners, directly or by others; groups share none.
    """

    seconds: Floats
    std: Floats
    people: int
    runs: Flags
    groups: tuple[tuple[int, ...], ...] = ()


def estimate_plane_clocks(
    positions: GroundPositions,
    fps: float,
    *,
    pitch_size: tuple[float, float],
    max_offset_s: float = 1.0,
) -> PlaneClocks:
    """Return the cameras' clock offsets from people who run in the view of two cameras.

    Each camera tracks its people alone. Two cameras' tracks of one person differ by the velocity
    times the clock offset, and by the disagreement of the two calibrations, which is an affine map
    here. Of a long clip, two cameras are compared in the part in which they share most people.
    `pitch_size` is the length and width of the pitch [m], `max_offset_s` the largest offset [s].
    """
    cameras = positions.xy.shape[1]
    longest = round((30.0 + 2.0 * max_offset_s) * fps)

    @cache
    def track_alone(camera: int, first: int) -> GroundTracks:
        at = slice(first, first + longest), slice(camera, camera + 1)
        arrays = positions.arrays()
        one = (arrays[name][at] for name in ("xy", "noise", "calibration", "height"))
        return track_on_plane(GroundPositions(*one), fps, pitch_size=pitch_size)

    runs = np.zeros(cameras, dtype=np.bool_)
    rows, values, weights, count = [], [], [], 0
    for a, b in combinations(range(cameras), 2):
        first = _choose_part(positions, (a, b), longest, fps, max_offset_s)
        alone = [track_alone(camera, first) for camera in (a, b)]
        runs[[a, b]] |= np.array([_see_runners(each.velocity) for each in alone])
        found = _compare_clocks(alone[0].xy, alone[1].xy, fps, max_offset_s)
        if found is None:
            continue
        row = np.zeros(cameras)
        row[a], row[b] = -1.0, 1.0
        rows.append(row)
        values.append(found[0])
        weights.append(1.0 / found[1])
        count += found[2]
    seconds, std, groups = (
        np.zeros(cameras),
        np.full(cameras, np.inf),
        tuple[tuple[int, ...], ...](),
    )
    if rows:
        scale = np.array(weights)
        matrix = np.stack(rows) * scale[:, None]
        inverse = np.linalg.pinv(matrix.T @ matrix)
        told = np.abs(matrix).sum(axis=0) > 0.0
        seconds = inverse @ matrix.T @ (np.array(values) * scale)
        std[told] = np.sqrt(np.diag(inverse))[told]
        number, label = connected_components(matrix.T @ matrix)
        members = (tuple(np.flatnonzero(label == k).tolist()) for k in range(number))
        groups = tuple(group for group in members if len(group) > 1)
    return PlaneClocks(seconds, std, count, runs, groups)


def _choose_part(
    positions: GroundPositions, pair: tuple[int, int], longest: int, fps: float, max_offset_s: float
) -> int:
    """Return the first of the `longest` frames in which most people of one camera are near others.

    Within the largest offset, a runner of 5 m/s is not farther from the other camera's image.
    """
    frames = positions.xy.shape[0]
    starts = np.linspace(0, max(0, frames - longest), -(-frames // longest)).astype(int)
    if len(starts) < 2:
        return 0
    (one, other), reach = pair, 2.0 + 5.0 * max_offset_s
    counts = [
        sum(
            len(_mutual(positions.xy[f, one], positions.xy[f, other], reach))
            for f in range(start, start + longest, max(1, round(fps)))
        )
        for start in starts.tolist()
    ]
    return int(starts[int(np.argmax(counts))])


def _see_runners(velocity: Floats) -> bool:
    """Return whether enough of the people with velocities (frames, people, 2) [m/s] run."""
    seen = np.isfinite(velocity[..., 0]).any(axis=0)
    speed = np.sqrt(np.nanmean((velocity[:, seen] ** 2).sum(axis=-1), axis=0))
    return bool((speed > 1.0).sum() >= MIN_RUNNERS)


def _compare_clocks(
    a: Floats, b: Floats, fps: float, max_offset_s: float
) -> tuple[float, float, int] | None:
    """Return clock of b minus clock of a, its standard deviation [s], and the number of pairs."""
    most = min(round(max_offset_s * fps), len(a) // 2)
    if not a.shape[1] or not b.shape[1]:
        return None
    costs = {late: _shifted_cost(a, b, late) for late in range(-most, most + 1)}
    known = {late: cost for late, cost in costs.items() if np.isfinite(cost)}
    if not known:
        return None
    late = float(min(known, key=lambda each: known[each]))
    pairs = _pair_tracks(a, _shift(b, late))
    if len(pairs) < MIN_RUNNERS:
        return None
    for _ in range(10):
        step = _refine(a, b, late, pairs)
        late = float(np.clip(late + np.clip(step, -1.0, 1.0), -most, most))
        if abs(step) < 1e-3:
            break
    left_out = [
        late + _refine(a, b, late, [pair for pair in pairs if pair is not out]) for out in pairs
    ]
    n = len(pairs)
    std = float(np.sqrt((n - 1) / n * np.sum((np.array(left_out) - np.mean(left_out)) ** 2)))
    return -late / fps, max(std, 0.01) / fps, n


def _shift(b: Floats, late: float) -> Floats:
    """Return tracks (frames, persons, 2) at `late` frames after each frame; NaN outside."""
    at = np.arange(len(b)) + late
    lower = np.floor(at).astype(np.int64)
    part = (at - lower)[:, None, None]
    inside = (lower >= 0) & (lower + 1 < len(b))
    inside |= (lower >= 0) & (lower < len(b)) & (part[:, 0, 0] == 0.0)
    first = b[np.clip(lower, 0, len(b) - 1)]
    second = b[np.clip(lower + 1, 0, len(b) - 1)]
    between = np.where(part > 0.0, (1.0 - part) * first + part * second, first)
    return np.where(inside[:, None, None], between, np.nan)


def _mutual(a: Floats, b: Floats, reach: float = 2.0) -> list[tuple[int, int, float]]:
    """Return mutual nearest neighbours (i, j, distance) of one frame, within a reach [m]."""
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    return [
        (i, int(j), float(distance[i, j]))
        for i, j in enumerate(nearest)
        if back[j] == i and distance[i, j] <= reach
    ]


def _shifted_cost(a: Floats, b: Floats, late: int) -> float:
    """Return the mean squared distance of nearest people [m^2]; NaN if fewer than `MIN_RUNNERS`."""
    shifted = _shift(b, float(late))
    squared = [d**2 for f in range(0, len(a), 3) for _, _, d in _mutual(a[f], shifted[f])]
    return float(np.mean(squared)) if len(squared) >= MIN_RUNNERS else np.nan


def _pair_tracks(a: Floats, b: Floats) -> list[tuple[int, int]]:
    """Return the tracks that are nearest to each other in most of their common frames."""
    votes: dict[tuple[int, int], int] = {}
    for f in range(len(a)):
        for i, j, _ in _mutual(a[f], b[f]):
            votes[i, j] = votes.get((i, j), 0) + 1
    common = np.isfinite(a[..., 0]).T.astype(float) @ np.isfinite(b[..., 0]).astype(float)
    return [pair for pair, n in votes.items() if n >= 5 and n > 0.5 * common[pair]]


def _refine(a: Floats, b: Floats, late: float, pairs: list[tuple[int, int]]) -> float:
    """Return the change of `late` [frames] that, with an affine map, reduces the distances."""
    here, faster = _shift(b, late), _shift(b, late + 0.5) - _shift(b, late - 0.5)
    rows, values = [], []
    for i, j in pairs:
        known = np.isfinite(a[:, i, 0]) & np.isfinite(here[:, j, 0])
        known &= np.isfinite(faster[:, j, 0])
        place, velocity, off = here[known, j], faster[known, j], a[known, i] - here[known, j]
        for axis in range(2):
            design = np.zeros((len(place), 7))
            design[:, 0] = velocity[:, axis]
            design[:, 1 + 3 * axis] = 1.0
            design[:, 2 + 3 * axis : 4 + 3 * axis] = place / 30.0
            rows.append(design)
            values.append(off[:, axis])
    matrix, value = np.concatenate(rows), np.concatenate(values)
    weight = np.ones(len(value))
    solution = np.zeros(7)
    ridge = 1e-3 * np.eye(7)
    for _ in range(5):
        weighted = matrix * weight[:, None]
        solution = np.linalg.solve(weighted.T @ matrix + ridge, weighted.T @ value)
        residual = np.abs(value - matrix @ solution)
        scale = 1.5 * 1.4826 * np.median(residual) + 1e-6
        weight = np.minimum(1.0, scale / np.maximum(residual, 1e-9))
    return float(solution[0])
