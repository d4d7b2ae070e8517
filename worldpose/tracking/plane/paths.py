"""Smoothed tracks of feet on the pitch plane: which are one person's, and which are no person's."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.tracking.plane.feet import PART_OVERLAP, FrameBlocks, GroundPositions

MIN_TRACK_S: Final = 0.4
"""Least time with detections of a track [s]."""
DOUBLE_DISTANCE: Final = 1.0
"""A second track of a person stays this near to the first [m]."""


@dataclass(frozen=True, eq=False)
class PlanePath:
    """A smoothed track from frame `first` on.

    Attributes:
        state: (frames, 4) state of the track, place and velocity [m, m/s].
        covariance: (frames, 4, 4).
        index: frame to camera to detection.
        person: triangulated person; -1 = none.
    """

    first: int
    state: Floats
    covariance: Floats
    index: dict[int, dict[int, int]]
    person: int = -1

    @property
    def xy(self) -> Floats:
        """Return places (frames, 2) [m]."""
        return self.state[:, :2]

    @property
    def last(self) -> int:
        """Return the last frame."""
        return self.first + len(self.state) - 1


def merge_paths(paths: list[PlanePath], fps: float, positions: GroundPositions) -> list[PlanePath]:
    """Join paths that are one person's, in the order of the paths; a joined path is the last."""
    left, number = dict(enumerate(paths)), count(len(paths))
    by_start = sorted(left, key=lambda k: paths[k].first)
    together: list[tuple[int, int]] = []  # a heap of the pairs with common frames
    starts = [paths[k].first for k in by_start]
    for place, k in enumerate(by_start):
        later = by_start[place + 1 : bisect_right(starts, paths[k].last)]
        together += [(min(k, n), max(k, n)) for n in later]
    heapify(together)
    while together:
        a, b = heappop(together)
        if a in left and b in left and _is_same_person(left[a], left[b], fps, positions):
            both, new = _join(left.pop(a), left.pop(b)), next(number)
            for k, path in left.items():
                if path.first <= both.last and both.first <= path.last:
                    heappush(together, (k, new))
            left[new] = both
    return list(left.values())


def _common(a: PlanePath, b: PlanePath) -> tuple[slice, slice]:
    """Return the common frames of two paths, as rows of each; empty if there are none."""
    first, last = max(a.first, b.first), max(min(a.last, b.last), max(a.first, b.first) - 1)
    return (slice(first - a.first, last - a.first + 1), slice(first - b.first, last - b.first + 1))


def _is_same_person(a: PlanePath, b: PlanePath, fps: float, positions: GroundPositions) -> bool:
    """Return whether two paths are one person's.

    Either they stay near each other and no camera sees both in one frame, or they lie so close for
    so long that two bodies would be in one place, or their boxes always overlap and one of them is
    a part: two boxes of one person.
    """
    if a.person >= 0 and b.person >= 0:
        return False
    ours, theirs = _common(a, b)
    apart = np.linalg.norm(a.xy[ours] - b.xy[theirs], axis=1)
    if not len(apart):
        return False
    inside = len(apart) >= MIN_TRACK_S * fps and np.quantile(apart, 0.9) < DOUBLE_DISTANCE
    if inside and np.median(apart) < 0.5:
        return True
    both = [
        (frame, camera)
        for frame in sorted(set(a.index) & set(b.index))
        for camera in set(a.index[frame]) & set(b.index[frame])
    ]
    if not both:
        is_brief = len(apart) < MIN_TRACK_S * fps  # then two who pass each other are near, too
        return bool(apart.mean() <= 1.0 and not (is_brief and _move_apart(a, b)))
    boxes, whole = positions.boxes, positions.is_whole
    if boxes is None or whole is None or len(both) < MIN_TRACK_S * fps:
        return False
    # Two boxes of one person differ by an error along the line of sight.
    if np.median(apart) > 2.5:
        return False
    parts = [
        not all(whole[frame, camera, path.index[frame][camera]] for path in (a, b))
        for frame, camera in both
    ]
    first, second = (
        np.stack([boxes[frame, camera, path.index[frame][camera]] for frame, camera in both])
        for path in (a, b)
    )
    low, high = np.maximum(first[:, :2], second[:, :2]), np.minimum(first[:, 2:], second[:, 2:])
    smaller = np.minimum(*((box[:, 2:] - box[:, :2]).prod(axis=1) for box in (first, second)))
    overlapping = np.clip(high - low, 0.0, None).prod(axis=1) >= PART_OVERLAP * smaller
    # A detector gives two boxes for the person all the time, and two people part.
    return bool((overlapping & np.array(parts)).mean() >= 0.8)


def _move_apart(a: PlanePath, b: PlanePath) -> bool:
    """Return whether velocities contradict each other: by their covariance, in common frames."""
    ours, theirs = _common(a, b)
    off = (a.state[ours] - b.state[theirs])[:, 2:]
    covariance = (a.covariance[ours] + b.covariance[theirs])[:, 2:, 2:]
    squared = np.einsum("fi,fij,fj->f", off, np.linalg.inv(covariance), off)
    return bool(squared.mean() > 9.2)  # of 99 % of normal errors in the plane


def _join(a: PlanePath, b: PlanePath) -> PlanePath:
    """Return two paths of one person as one; the longer one's detections count where both have."""
    if len(b.index) > len(a.index):
        a, b = b, a
    ours, theirs = _common(a, b)
    start, stop = min(a.first, b.first), max(a.last, b.last)
    state = np.full((stop - start + 1, 4), np.nan)
    covariance = np.full((stop - start + 1, 4, 4), np.nan)
    for path in (a, b):
        rows = slice(path.first - start, path.last - start + 1)
        state[rows], covariance[rows] = path.state, path.covariance
    rows = slice(a.first + ours.start - start, a.first + ours.stop - start)
    inverse_a, inverse_b = (np.linalg.inv(p.covariance[s]) for p, s in ((a, ours), (b, theirs)))
    covariance[rows] = np.linalg.inv(inverse_a + inverse_b)
    total = inverse_a @ a.state[ours][..., None] + inverse_b @ b.state[theirs][..., None]
    state[rows] = (covariance[rows] @ total)[..., 0]
    index = {
        frame: {**b.index.get(frame, {}), **a.index.get(frame, {})}
        for frame in sorted(set(a.index) | set(b.index))
    }
    return PlanePath(start, state, covariance, index, max(a.person, b.person))


def drop_doubles(paths: list[PlanePath]) -> list[PlanePath]:
    """Drop paths that always stay close to a longer one: second boxes of the same person.

    Two players in a tackle have been apart before, or part after it.
    """
    kept: list[PlanePath] = []
    for path in sorted(paths, key=lambda path: -len(path.xy)):
        if path.person >= 0 or not any(_is_double(path, other) for other in kept):
            kept.append(path)
    return kept


def _is_double(path: PlanePath, other: PlanePath) -> bool:
    """Return whether `path` lies in the time of `other`, which is longer, and always near it."""
    if len(path.xy) > 0.7 * len(other.xy):
        return False
    if path.first < other.first or path.last > other.last:
        return False
    there = other.xy[path.first - other.first : path.last - other.first + 1]
    return bool((np.linalg.norm(path.xy - there, axis=1) < DOUBLE_DISTANCE).all())


def is_flag(path: PlanePath, pitch_size: tuple[float, float]) -> bool:
    """Return whether a path never leaves a corner: a flag, which nets mistake for people."""
    corner = np.abs(path.xy) - 0.5 * np.asarray(pitch_size)
    return bool((np.linalg.norm(corner, axis=1) < 1.0).all())


def track_height(path: PlanePath, positions: GroundPositions) -> float:
    """Return the median height of a path's person [m]; NaN where not known."""
    heights = [
        positions.height[frame, camera, detection]
        for frame, seen in path.index.items()
        for camera, detection in seen.items()
    ]
    known = np.array(heights)[np.isfinite(heights)]
    return float(np.median(known)) if len(known) else np.nan


def has_odd_height(path: PlanePath, positions: GroundPositions) -> bool:
    """Return whether no person has the path's height: a ball, a mark, two people in one box."""
    height = track_height(path, positions)
    return bool(np.isfinite(height)) and not 1.1 <= height <= 2.4


def is_contradicted(path: PlanePath, covering: NDArray[np.integer] | FrameBlocks | None) -> bool:
    """Return whether most cameras that cover the path's places do not see the person."""
    if covering is None:
        return False
    sights = [(f, c, d) for f, seen in path.index.items() for c, d in seen.items()]
    cover = np.mean([covering[sight] for sight in sights])
    # One of three may; where more look and see no person, the detection is none.
    return bool(len(sights) / len(path.index) < 0.34 * cover)
