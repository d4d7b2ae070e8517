"""Smoothed joints of whole tracks, and the typical accelerations that smoothing needs.

A joint over time is the least-squares answer to reprojection errors and a penalty on acceleration.
The unknowns x, y, z of all frames form a symmetric matrix whose entries lie within six places of
the diagonal: a frame's own 3x3 block, and an acceleration ties each coordinate to those of two
frames before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import compile_kernel, map_in_threads
from worldpose.geometry import projection
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.batched_gauss_newton import (
    LANES,
    MATRIX,
    POINT,
    PRECISION,
    RIGHT,
    ROWS,
    SHARPNESS,
    SQUARED,
    STATE,
    USED,
    accumulate,
    clear,
)
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.observations import (
    Observations,
    PersonTrack,
    Rig,
    gather,
    linearize,
    observe_person,
)
from worldpose.triangulation.passes import Triangulation
from worldpose.triangulation.reports import Changes, Histogram, SmoothingReport
from worldpose.triangulation.settings import TriangulationSettings

BAND: Final = 6
MAX_STEPS: Final = 12
CONVERGED: Final = 1e-4
"""Largest step of a coordinate that ends the iteration [m]: a hundredth of the noise."""


class TrackCosts(NamedTuple):
    """Weights of errors of observations and of accelerations.

    Attributes:
        noise: noise of observations, [px] and [m].
        limit: scale of the Geman-McClure loss of observations [variances].
        penalty: on squared second differences [1/m^2].
    """

    noise: tuple[float, float]
    limit: float
    penalty: float


def solve_segment(
    pixels: Floats,
    weights: Floats,
    given: Floats,
    rig: Rig,
    costs: TrackCosts,
) -> tuple[Floats, Floats]:
    """Return a joint's points (frames, 3) [m] and covariance (frames, 3, 3) [m^2] over time.

    Args:
        pixels: (cameras, frames, 2) [px].
        weights: (cameras, frames), inverse of the factor on the stated variance; 0 or NaN = no
            observation.
        given: (frames, 3) [m], initial points; the first and last frame are not NaN.
        rig: the cameras.
        costs: weights of the two kinds of errors.
    """
    return _solve_tiles(prepare_tiles(pixels, weights, rig), given, rig, costs)


def _solve_tiles(
    tiles: Floats, given: Floats, rig: Rig, costs: TrackCosts
) -> tuple[Floats, Floats]:
    """Return what `solve_segment` does, from the tiles of its observations."""
    frames = np.arange(len(given))
    known = np.isfinite(given[:, 0])
    columns = [np.interp(frames, frames[known], column[known]) for column in given.T]
    points = np.stack(columns, axis=-1)
    covariance = np.empty((len(points), 3, 3))
    _solve_track(tiles, rig.depths, costs, points, covariance)
    return points, covariance


def prepare_tiles(pixels: Floats, weights: Floats, rig: Rig) -> Floats:
    """Return tiles of one joint's observations, one lane per frame; all are used."""
    count, frames = weights.shape
    tiles = np.empty((-(-frames // LANES), count, ROWS * LANES))
    index = np.zeros((1, count, 1), np.int64)
    shape = (1, count, 1, frames)
    image = pixels.reshape(1, count, 1, frames, 2)
    _write_tiles(Observations.from_rig(rig, image, weights.reshape(shape), index), tiles)
    return tiles


@compile_kernel
def _write_tiles(observations: Observations, tiles: Floats) -> None:
    """Write the tiles of a track's observations (one frame, one person, a "joint" per frame)."""
    cameras = observations.cameras
    for part in range(len(tiles)):
        gather(observations, part * LANES, tiles[part])
        for camera in range(len(cameras)):
            linearize(tiles[part, camera], cameras[camera])
            tiles[part, camera, USED : USED + LANES] = 1.0


@compile_kernel
def _solve_track(
    tiles: Floats,
    depths: Floats,
    costs: TrackCosts,
    points: Floats,
    covariance: Floats,
) -> None:
    """Minimize reprojection errors and the acceleration penalty over the points of a track.

    Observations have a Geman-McClure loss of scale `costs.limit`.

    Args:
        tiles: tiles of `prepare_tiles`.
        depths: (cameras, 4).
        costs: weights of errors.
        points: (frames, 3) [m], initial values; written.
        covariance: (frames, 3, 3) [m^2], written.
    """
    frames = len(points)
    size = 3 * frames
    band, right = np.empty((size, BAND + 1)), np.empty(size)
    state = np.empty(STATE * LANES)
    for _ in range(MAX_STEPS):
        _write_equations(tiles, depths, costs, points, state, band, right)
        _factorize(band)
        _substitute(band, right)
        largest = 0.0
        for i in range(size):
            points[i // 3, i % 3] += right[i]
            largest = max(largest, abs(right[i]))
        if not largest > CONVERGED:
            break
    _invert(band)
    for t in range(frames):
        for a in range(3):
            for b in range(a + 1):
                value = band[3 * t + a, a - b]
                covariance[t, a, b] = covariance[t, b, a] = value


@compile_kernel
def held_out_cost(
    tiles: Floats, depths: Floats, noise: tuple[float, float], limit: float, points: Floats
) -> float:
    """Return the sum of the loss over the observations of a track at given points."""
    state = np.empty(STATE * LANES)
    total = 0.0
    for part in range(len(tiles)):
        _place(points, part, state)
        state[SHARPNESS : SHARPNESS + LANES] = 1.0 / limit
        clear(state)
        for camera in range(len(depths)):
            tile = tiles[part, camera]
            accumulate(tile, depths[camera], noise, state)
            for j in range(min(LANES, len(points) - part * LANES)):
                if tile[PRECISION + j] > 0.0:
                    squared = tile[SQUARED + j]
                    total += limit if squared == math.inf else limit * squared / (limit + squared)
    return total


@compile_kernel
def _place(points: Floats, part: int, state: Floats) -> None:
    """Copy the points of one tile into its state."""
    for j in range(LANES):
        t = min(part * LANES + j, len(points) - 1)
        for axis in range(3):
            state[POINT + axis * LANES + j] = points[t, axis]


@compile_kernel
def _write_equations(
    tiles: Floats,
    depths: Floats,
    costs: TrackCosts,
    points: Floats,
    state: Floats,
    band: Floats,
    right: Floats,
) -> None:
    """Write the Gauss-Newton matrix by rows, `band[i, k]` = entry (i, i - k), and right side."""
    noise, limit, penalty = costs.noise, costs.limit, costs.penalty
    frames = len(points)
    band[:] = 0.0
    for part in range(len(tiles)):
        _place(points, part, state)
        state[SHARPNESS : SHARPNESS + LANES] = 1.0 / limit
        clear(state)
        for camera in range(len(depths)):
            accumulate(tiles[part, camera], depths[camera], noise, state)
        for j in range(min(LANES, frames - part * LANES)):
            i = 3 * (part * LANES + j)
            band[i, 0] = state[MATRIX + j]
            band[i + 1, 1] = state[MATRIX + LANES + j]
            band[i + 2, 2] = state[MATRIX + 2 * LANES + j]
            band[i + 1, 0] = state[MATRIX + 3 * LANES + j]
            band[i + 2, 1] = state[MATRIX + 4 * LANES + j]
            band[i + 2, 0] = state[MATRIX + 5 * LANES + j]
            for axis in range(3):
                right[i + axis] = state[RIGHT + axis * LANES + j]
    for t in range(2, frames):
        for axis in range(3):
            i = 3 * t + axis
            bend = points[t, axis] - 2.0 * points[t - 1, axis] + points[t - 2, axis]
            right[i] -= penalty * bend
            right[i - 3] += 2.0 * penalty * bend
            right[i - 6] -= penalty * bend
            band[i, 0] += penalty
            band[i - 3, 0] += 4.0 * penalty
            band[i - 6, 0] += penalty
            band[i, 3] -= 2.0 * penalty
            band[i - 3, 3] -= 2.0 * penalty
            band[i, 6] += penalty


@compile_kernel
def _factorize(band: Floats) -> None:
    """Replace the matrix by its Cholesky factor, `band[i, k]` = L(i, i - k)."""
    for i in range(len(band)):
        for k in range(min(BAND, i), -1, -1):
            j = i - k
            total = band[i, k]
            for m in range(k + 1, min(BAND, i) + 1):
                if m - k <= BAND:
                    total -= band[i, m] * band[j, m - k]
            band[i, k] = math.sqrt(total) if k == 0 else total / band[j, 0]


@compile_kernel
def _substitute(band: Floats, right: Floats) -> None:
    """Replace the right side by the solution."""
    size = len(right)
    for i in range(size):
        for k in range(1, min(BAND, i) + 1):
            right[i] -= band[i, k] * right[i - k]
        right[i] /= band[i, 0]
    for i in range(size - 1, -1, -1):
        for k in range(1, min(BAND, size - 1 - i) + 1):
            right[i] -= band[i + k, k] * right[i + k]
        right[i] /= band[i, 0]


@compile_kernel
def _invert(band: Floats) -> None:
    """Replace the factor by the inverse's entries within the band (Takahashi 1973)."""
    size = len(band)
    row = np.empty(BAND + 1)
    for i in range(size - 1, -1, -1):
        reach = min(BAND, size - 1 - i)
        diagonal = band[i, 0]
        # Column i of the factor below the diagonal, before its places are overwritten.
        for k in range(1, reach + 1):
            row[k] = band[i + k, k]
        for k in range(reach, -1, -1):
            j = i + k
            total = 1.0 / diagonal if k == 0 else 0.0
            for m in range(1, reach + 1):
                low, high = min(i + m, j), max(i + m, j)
                total -= row[m] * band[high, high - low]
            band[j, k] = total / diagonal


ACCELERATIONS: Final = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
"""Candidates [m/s^2]: from a stroller's trunk to a kicking foot."""
USUAL: Final = 25.0
"""Default without data [m/s^2]."""
WINDOWS: Final = 12
"""Intervals of tracks in the sample."""
WINDOW: Final = 2.0
"""Length of an interval [s]."""
REPEAT: Final = 0.2
"""Time over which errors may be correlated [s]: the averaging time of smoothing."""


@dataclass(frozen=True, eq=False)
class MotionModel:
    """Motion prior of smoothing.

    Attributes:
        acceleration: (joints,) standard deviation per axis [m/s^2].
        repeated: frames whose errors count as one, at least 1.
    """

    acceleration: Floats
    repeated: float


def learn_motion(
    rig: Rig,
    tracks: Iterable[PersonTrack],
    joints: int,
    fps: float,
    settings: TriangulationSettings,
) -> MotionModel:
    """Return the accelerations that predict held-out cameras best.

    Joints are smoothed from every other camera and compared with the observations of the held-out
    cameras. This penalizes too much smoothing as well as too little. Errors that a detector repeats
    from frame to frame differ between cameras, so they do not count as motion. Left and right share
    one value.

    Args:
        rig: the cameras.
        tracks: intervals of one person each.
        joints: number of joints per person.
        fps: frames per second [1/s].
        settings: noise and inlier limit.
    """
    names = [name.split("_")[-1] for name in COCO17]
    limit, noise = settings.max_deviation**2, settings.noise
    kind = np.unique(names, return_inverse=True)[1] if joints == len(COCO17) else np.arange(joints)
    cost = np.zeros((len(ACCELERATIONS), joints))
    lag = max(1, round(REPEAT * fps))
    correlation, energy = np.zeros(lag + 1), 0.0
    odd = np.arange(len(rig.cameras)) % 2 == 1

    def predict(track: PersonTrack) -> list[tuple[int, list[Floats], Floats]]:
        """Return each joint with its costs (candidates,) of both halves, and its errors."""
        pixels, weights, points = track.pixels, track.precision, track.joints
        found = []
        for joint in range(joints):
            given = np.ascontiguousarray(points[:, joint])
            if not np.isfinite(given).all():
                continue
            costs = []
            for left_out in (odd, ~odd):
                seen = np.where(left_out[:, None], 0.0, weights[joint])
                hidden = np.where(left_out[:, None], weights[joint], 0.0)
                if ((seen > 0.0).sum(axis=0) < settings.min_views).any():
                    continue
                tiles = prepare_tiles(pixels[joint], hidden, rig)
                seen_tiles = prepare_tiles(pixels[joint], seen, rig)
                own = np.empty(len(ACCELERATIONS))
                for n, acceleration in enumerate(ACCELERATIONS):
                    weighed = TrackCosts(noise, limit, (fps**2 / acceleration) ** 2)
                    x, _ = _solve_tiles(seen_tiles, given, rig, weighed)
                    own[n] = held_out_cost(tiles, rig.depths, noise, limit, x)
                costs.append(own)
            error = _whiten_errors(pixels[joint], weights[joint], given, rig, noise, limit)
            found.append((joint, costs, error))
        return found

    for found in map_in_threads(predict, tracks):
        for joint, costs, error in found:
            for own in costs:
                cost[:, joint] += own
            energy += float(np.nansum(error * error))
            for k in range(1, lag + 1):
                correlation[k] += float(np.nansum(error[:, k:] * error[:, :-k]))
    total = np.stack([np.bincount(kind, row) for row in cost])[:, kind]
    best = np.array(ACCELERATIONS)[total.argmin(axis=0)]
    best = np.where(total.max(axis=0) > 0.0, best, USUAL)
    alike = np.maximum(correlation[1:] / energy, 0.0) if energy > 0.0 else np.zeros(lag)
    return MotionModel(best, float(1.0 + 2.0 * alike.sum()))


def choose_stretches(there: NDArray[np.bool_], fps: float) -> list[tuple[int, slice]]:
    """Return persons and intervals of frames to learn from, spread over the clip.

    Args:
        there: (frames, persons), whether the person can be triangulated.
        fps: frames per second [1/s].
    """
    frames, persons = there.shape
    length = max(1, min(frames, round(WINDOW * fps)))
    every = [
        (person, slice(start, start + length))
        for start in range(0, max(1, frames - length + 1), length)
        for person in range(persons)
        if 2 * there[start : start + length, person].sum() > length
    ]
    chosen = np.linspace(0, len(every) - 1, min(len(every), WINDOWS)).astype(int)
    return [every[n] for n in np.unique(chosen)]


def _whiten_errors(
    pixels: Floats,
    weights: Floats,
    points: Floats,
    rig: Rig,
    noise: tuple[float, float],
    limit: float,
) -> Floats:
    """Return errors (cameras, frames, 2) in standard deviations; NaN for outlier views."""
    image = np.empty(pixels.shape)
    at = np.ascontiguousarray(np.broadcast_to(points, (*image.shape[:2], 3)))
    projection.project(rig.cameras, at, image)
    depth = at @ rig.depths[:, :3, None] + rig.depths[:, 3, None, None]
    size = rig.cameras[:, 0, None, None] / depth
    variance = noise[0] ** 2 + (size * noise[1]) ** 2
    usable = weights > 0.0
    error = (image - pixels) * np.sqrt(np.where(usable, weights, np.nan)[..., None] / variance)
    squared = (error**2).sum(axis=-1, keepdims=True)
    return np.where(squared <= limit, error, np.nan)


@dataclass(frozen=True)
class Smoothing:
    """Smoothed joints of whole tracks.

    Attributes:
        joints: (frames, persons, 17, 3) [m], world; NaN outside tracks and in long gaps.
        covariance: (frames, persons, 17, 3, 3) [m^2], growing into gaps.
        filled: (frames, persons, 17) bool, interpolated between two triangulated frames.
        motion: motion prior.
        changes: counts and distances behind `report`.
    """

    joints: Floats
    covariance: Floats
    filled: NDArray[np.bool_]
    motion: MotionModel
    changes: Changes

    @property
    def report(self) -> SmoothingReport:
        """The metrics of these frames."""
        return self.changes.report(self.motion.acceleration, self.motion.repeated)


def smooth_joints(
    cameras: Camera,
    detections: KeypointDetections,
    raw: Triangulation,
    fps: float,
    settings: TriangulationSettings,
    motion: MotionModel | None = None,
    core: slice = slice(None),
) -> Smoothing:
    """Return joints that fit the observations of their whole track with little acceleration.

    The fit uses the observations, not the triangulated joints: even a single view constrains a
    joint. The prior on acceleration is learned (`learn_motion`).

    Args:
        cameras: batch (cameras,).
        detections: detections of all tracked people.
        raw: triangulation of the same detections; its noise, offsets and left-right swaps are used.
        fps: frames per second [1/s].
        settings: noise and the longest gap.
        motion: motion prior of the clip of these frames; None = these frames are the clip.
        core: frames to return; the others only support them.
    """
    rig = Rig.from_cameras(cameras)
    detections = undo_swaps(detections, raw.exchanged)
    precision = raw.noise.precision(detections.confidence)
    joints, covariance = np.full_like(raw.joints, np.nan), np.full_like(raw.covariance, np.nan)
    if motion is None:
        chosen = choose_stretches(np.asarray(raw.views.any(axis=-1)), fps)
        tracks = (
            observe_person(detections, precision, raw.offsets, raw.joints, person, part)
            for person, part in chosen
        )
        motion = learn_motion(rig, tracks, raw.joints.shape[2], fps, settings)
    penalty = (fps**2 / motion.acceleration) ** 2
    gap = round(settings.max_filled_gap_s * fps)
    limit = settings.max_deviation**2
    repeated = motion.repeated

    def smooth_person(person: int) -> None:
        track = observe_person(detections, precision, raw.offsets, raw.joints, person)
        weights = track.precision / repeated
        for joint in range(raw.joints.shape[2]):
            given = raw.joints[:, person, joint]
            costs = TrackCosts(settings.noise, limit, float(penalty[joint]))
            for part in segments(np.isfinite(given[:, 0]), gap):
                pixels = track.pixels[joint, :, part]
                x, c = solve_segment(pixels, weights[joint, :, part], given[part], rig, costs)
                # One gross error must not spoil a whole track.
                good = np.isfinite(x).all() and np.isfinite(c).all()
                joints[part, person, joint] = x if good else given[part]
                covariance[part, person, joint] = (
                    c + _nearest(raw.calibration_covariance[part, person, joint], given[part])
                    if good
                    else raw.covariance[part, person, joint]
                )

    for _ in map_in_threads(smooth_person, range(raw.joints.shape[1])):
        pass
    joints, covariance, given = joints[core], covariance[core], raw.joints[core]
    there, triangulated = np.isfinite(joints[..., 0]), np.isfinite(given[..., 0])
    filled = there & ~triangulated
    moved = np.linalg.norm(joints - given, axis=-1)[there & triangulated]
    changes = Changes(int(there.sum()), int(filled.sum()), Histogram.of(moved))
    return Smoothing(joints, covariance, filled, motion, changes)


def segments(there: NDArray[np.bool_], gap: int) -> list[slice]:
    """Return the intervals that begin and end with a joint and have no gap above `gap` frames."""
    frames = np.flatnonzero(there)
    if not len(frames):
        return []
    breaks = np.flatnonzero(np.diff(frames) > gap + 1)
    first = [frames[0], *frames[breaks + 1]]
    last = [*frames[breaks], frames[-1]]
    return [slice(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]


def _nearest(matrices: Floats, given: Floats) -> Floats:
    """Return the matrices (frames, 3, 3); a frame without a joint takes the last one before."""
    known = np.isfinite(given[:, 0])
    last = np.maximum.accumulate(np.where(known, np.arange(len(given)), 0))
    return matrices[last]
