"""Smoothed joints of whole tracks, and the typical accelerations that smoothing needs.

A joint over time minimizes E_track of `residuals`.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from worldpose.compiled import map_in_threads
from worldpose.geometry import camera_model
from worldpose.geometry.cameras import Camera
from worldpose.triangulation.limb_lengths import undo_swaps
from worldpose.triangulation.noise_model import conditions
from worldpose.triangulation.report import Changes, Histogram
from worldpose.triangulation.residuals import Rig
from worldpose.triangulation.results import MotionModel, Smoothing, Triangulation
from worldpose.triangulation.samples import choose_stretches
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.track_solver import (
    PersonKeypoints,
    TrackCosts,
    held_out_cost,
    prepare_tiles,
    select_person,
    solve_tiles,
)


def learn_motion(
    rig: Rig,
    tracks: Iterable[PersonKeypoints],
    joints: int,
    fps: float,
    settings: TriangulationSettings,
) -> MotionModel:
    """Return the accelerations that predict held-out cameras best, by intervals of one person.

    Joints are smoothed from every other camera and compared with the observations of the held-out
    cameras. This penalizes too much smoothing as well as too little. Errors that a detector repeats
    from frame to frame differ between cameras, so they do not count as motion.
    """
    names = [name.split("_")[-1] for name in COCO17]
    limit, noise = settings.max_deviation**2, settings.noise
    kind = np.unique(names, return_inverse=True)[1] if joints == len(COCO17) else np.arange(joints)
    # Candidates [m/s^2]: from a stroller's trunk to a kicking foot.
    accelerations = (3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0)
    cost = np.zeros((len(accelerations), joints))
    # Time over which errors may be correlated [s]: the averaging time of smoothing.
    lag = max(1, round(0.2 * fps))
    correlation, energy = np.zeros(lag + 1), 0.0
    odd = np.arange(len(rig.cameras)) % 2 == 1

    def predict(track: PersonKeypoints) -> list[tuple[int, list[Floats], Floats]]:
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
                own = np.empty(len(accelerations))
                for n, acceleration in enumerate(accelerations):
                    weighed = TrackCosts(noise, limit, (fps**2 / acceleration) ** 2)
                    x, _ = solve_tiles(seen_tiles, given, rig, weighed)
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
    best = np.array(accelerations)[total.argmin(axis=0)]
    # Default without data [m/s^2].
    best = np.where(total.max(axis=0) > 0.0, best, 25.0)
    alike = np.maximum(correlation[1:] / energy, 0.0) if energy > 0.0 else np.zeros(lag)
    return MotionModel(best, float(1.0 + 2.0 * alike.sum()))


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
    camera_model.project(rig.cameras, at, image)
    depth = at @ rig.depths[:, :3, None] + rig.depths[:, 3, None, None]
    size = rig.cameras[:, 0, None, None] / depth
    variance = noise[0] ** 2 + (size * noise[1]) ** 2
    usable = weights > 0.0
    error = (image - pixels) * np.sqrt(np.where(usable, weights, np.nan)[..., None] / variance)
    squared = (error**2).sum(axis=-1, keepdims=True)
    return np.where(squared <= limit, error, np.nan)


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
    precision = raw.noise.precision(detections.confidence, conditions(detections.keypoints))
    joints, covariance = np.full_like(raw.joints, np.nan), np.full_like(raw.covariance, np.nan)
    if motion is None:
        chosen = choose_stretches(np.asarray(raw.views.any(axis=-1)), fps)
        tracks = (
            select_person(detections, precision, raw.offsets, raw.joints, person, part)
            for person, part in chosen
        )
        motion = learn_motion(rig, tracks, raw.joints.shape[2], fps, settings)
    penalty = (fps**2 / motion.acceleration) ** 2
    gap = round(settings.max_filled_gap_s * fps)
    limit = settings.max_deviation**2
    repeated = motion.repeated

    def smooth_person(person: int) -> None:
        track = select_person(detections, precision, raw.offsets, raw.joints, person)
        weights = track.precision / repeated
        for joint in range(raw.joints.shape[2]):
            given = raw.joints[:, person, joint]
            costs = TrackCosts(settings.noise, limit, float(penalty[joint]))
            for part in segments(np.isfinite(given[:, 0]), gap):
                pixels = track.pixels[joint, :, part]
                tiles = prepare_tiles(pixels, weights[joint, :, part], rig)
                x, c = solve_tiles(tiles, given[part], rig, costs)
                # One gross error must not spoil a whole track.
                good = np.isfinite(x).all() and np.isfinite(c).all()
                joints[part, person, joint] = x if good else given[part]
                covariance[part, person, joint] = (
                    c + _nearest(raw.lasting_covariance[part, person, joint], given[part])
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
