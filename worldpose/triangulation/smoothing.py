"""Smoothed joints of whole tracks, with short gaps filled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.keypoints import TrackedDetections
from worldpose.geometry import Camera
from worldpose.triangulation.left_right_swaps import undo_swaps
from worldpose.triangulation.motion_model import MotionModel, choose_stretches, learn_motion
from worldpose.triangulation.observations import Rig, observe_person
from worldpose.triangulation.reports import Changes, Histogram, SmoothingReport
from worldpose.triangulation.robust import Triangulation
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.track_solver import TrackCosts, solve_segment


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
    detections: TrackedDetections,
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
        detections: of all tracked people.
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
    gap = round(settings.max_gap * fps)
    limit = settings.max_deviation**2
    for person in range(raw.joints.shape[1]):
        track = observe_person(detections, precision, raw.offsets, raw.joints, person)
        weights = track.precision / motion.repeated
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
