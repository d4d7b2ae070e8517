"""Health of each camera over time: how its images depart from the people whom all cameras place.

A keypoint x of camera c at time t departs from the projection p of the triangulated joint, whose
image moves by v per frame, as

    x - p = s + q (q . s) / f^2 + z q + r q' + l v + noise,

with q = p less the principal point, q' = q turned by 90 degrees, and f the focal length: a camera
that was knocked turned by s / f, which shifts the principal point by s [px], and by the roll r
[rad]; further a zoom z [1], and a clock offset l [frame]. Each bin of
frames has the normal equations of (s, z, r, l); `changes` finds where the solution changes.

`measure_health` joins this with what detections and images tell, as `HEALTH_MEASURES` of a clip.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import convolve1d

from data_contracts.arrays import Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import HEALTH_MEASURES
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import cauchy_loss, cauchy_weight

UNKNOWNS: Final = 5
"""Shift along x and y [px], zoom [1], roll [rad], clock offset [frame]."""
MAX_MISFIT: Final = 3.0
"""Misfit of a camera that somebody should look at, over the usual one of the rig [1]."""
LIMBS: Final = slice(5, 17)
"""Joints that are compared: those of the face move little and are often hidden."""


@dataclass(frozen=True, eq=False)
class CameraHealth:
    """Departures of each camera, in bins of frames.

    Attributes:
        length: frames of a bin.
        every: of this many frames, one is compared.
        matrix: (bins, cameras, 5, 5) normal matrices.
        right: (bins, cameras, 5) right-hand sides.
        sums: (bins, cameras, 3) sum of the image scale at people [px/m], number of terms, and sum
            of the robust loss of departures [1].
    """

    length: int
    every: int
    matrix: Floats
    right: Floats
    sums: Floats

    @classmethod
    def empty(cls, frames: int, cameras: int, persons: int, fps: float) -> CameraHealth:
        """Return bins of 0.2 s without departures."""
        length = max(1, round(0.2 * fps))
        # More frames cost time and tell little more.
        every = length if frames * cameras * persons > 50_000 else 1
        shape = (-(-frames // length), cameras)
        matrix, right = np.zeros((*shape, UNKNOWNS, UNKNOWNS)), np.zeros((*shape, UNKNOWNS))
        return cls(length, every, matrix, right, np.zeros((*shape, 3)))

    @property
    def misfit(self) -> Floats:
        """Mean robust loss of each camera's departures (cameras,) [1]; at most 2 if none moves."""
        _, terms, loss = self.sums.sum(axis=0).T
        return np.asarray(loss / np.maximum(1.0, 2.0 * terms))

    def over_time(self) -> Floats:
        """Return misfit [1], shift of the view [px] and clock offset [frame] in each bin.

        They are those of the second around it, (bins, cameras, 3); NaN with fewer than 20 terms.
        Where people tell nothing of a shift or an offset, it is 0.
        """
        matrix, right, sums = (
            convolve1d(each, np.ones(5), axis=0, mode="constant")
            for each in (self.matrix, self.right, self.sums)
        )
        usual = np.diag(np.array([50.0, 50.0, 0.05, 0.05, 5.0]) ** -2)  # in the unknowns' units
        solved = np.linalg.solve(matrix + usual, right[..., None])[..., 0]
        misfit = sums[..., 2] / np.maximum(1.0, 2.0 * sums[..., 1])
        found = np.stack([misfit, np.hypot(solved[..., 0], solved[..., 1]), solved[..., 4]], axis=2)
        found[sums[..., 1] < 20.0] = np.nan
        return found

    def add(
        self,
        cameras: Camera,
        people: KeypointDetections,
        joints: Floats,
        start: int,
        stated: Callable[[Floats], Floats] | None = None,
    ) -> None:
        """Add a chunk of a clip; its first and last frame give velocities only.

        Args:
            cameras: batch (cameras,).
            people: detections of tracked people, (frames, cameras, detections).
            joints: (frames, persons, 17, 3) triangulated [m], world.
            start: row of the first of these frames in the clip.
            stated: returns the variance per axis by the calibration (frames, cameras, persons)
                [px^2] at joints: what it explains is no misfit; None = it explains nothing.
        """
        rows = np.arange(1, len(joints) - 1)
        rows = rows[(start + rows) % self.every == self.every // 2]
        bins = (start + rows) // self.length
        if not len(rows):
            return
        points = np.stack([joints[rows + step][:, :, LIMBS] for step in (-1, 0, 1)])
        index = people.detection_index[rows]
        variance = None if stated is None else stated(joints[rows])
        for c in range(index.shape[1]):
            slot = index[:, c]
            frame, person = np.nonzero(slot >= 0)
            if len(frame):
                pixels = people.keypoints[rows[frame], c, slot[frame, person]][:, LIMBS]
                own = 0.0 if variance is None else variance[frame, c, person][:, None]
                there = points[:, frame, person]
                self._add_departures(c, cameras[c], bins[frame], pixels, there, own)

    def _add_departures(
        self,
        c: int,
        camera: Camera,
        bins: Integers,
        pixels: Floats,
        points: Floats,
        stated: Floats | float,
    ) -> None:
        """Add people (n,) of one camera, in rising bins, at points (3, n, 12, 3) over time."""
        joint_noise, pixel_noise = 0.03, 2.0  # of a detector [m], [px]
        focal = camera.focal.mean()
        before, image, after = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:-1], 2)
        speed, off = 0.5 * (after - before), pixels - image
        depth = camera.cam_from_world.apply(points[1].reshape(-1, 3))[:, 2].reshape(off.shape[:-1])
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = focal / depth
            variance = pixel_noise**2 + (joint_noise * scale) ** 2
            squared = (off**2).sum(axis=-1)
            weight = cauchy_weight(squared / variance, 5.0) / variance
            loss = cauchy_loss(squared / (variance + stated), 5.0)
        use = np.isfinite(weight) & np.isfinite(speed).all(axis=-1) & (depth > 0.0)
        terms = np.stack([scale, np.ones_like(scale), loss], axis=-1)
        terms = np.where(use[..., None], terms, 0.0).sum(axis=1)
        around = image - camera.principal_point
        columns = np.zeros((*off.shape, UNKNOWNS))
        columns[..., :2] = np.eye(2) + around[..., :, None] * around[..., None, :] / focal**2
        columns[..., 2] = around
        columns[..., 0, 3], columns[..., 1, 3] = -around[..., 1], around[..., 0]
        columns[..., 4] = speed
        weight = np.where(use, weight, 0.0)[..., None, None]
        columns = np.where(use[..., None, None], columns, 0.0).reshape(len(bins), -1, UNKNOWNS)
        off = np.where(use[..., None], off, 0.0).reshape(len(bins), -1, 1)
        weight = np.broadcast_to(weight[..., 0], (*use.shape, 2)).reshape(off.shape)
        held = (weight * columns).swapaxes(1, 2)
        each = np.concatenate([held @ columns, held @ off], axis=2)
        first = np.flatnonzero(np.diff(bins, prepend=-1))
        sums = np.add.reduceat(each, first, axis=0)
        self.matrix[bins[first], c] += sums[..., :UNKNOWNS]
        self.right[bins[first], c] += sums[..., UNKNOWNS]
        self.sums[bins[first], c] += np.add.reduceat(terms, first, axis=0)


def judge_health(values: Floats) -> Floats:
    """Return how bad the health (bins, cameras, `HEALTH_MEASURES`) is, (bins, cameras) [1].

    Above 1 somebody should look at the camera: its keypoints depart far more than those of the
    rig usually do, frames have no image, or its image became dark, bright or blurred. NaN = there
    is nothing to judge.
    """
    by = dict(zip(HEALTH_MEASURES, np.moveaxis(values, -1, 0), strict=True))
    parts = [2.0 * by["missing"]]
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # means of nothing
        usual = np.fmax(1.0, np.nanmedian(by["misfit"]))
        apart = by["misfit"] / (MAX_MISFIT * usual)
        # One bad camera displaces the people, and all others depart from them, too.
        spoilt = by["misfit"] < 0.5 * np.nanmax(by["misfit"], axis=1, keepdims=True)
        parts.append(np.where(spoilt, np.fmin(apart, 1.0), apart))
        images = [by[name] for name in ("brightness", "sharpness")]
        parts += [np.abs(np.log2(each / np.nanmedian(each, axis=0))) for each in images]  # by two
        return np.asarray(np.nanmax(parts, axis=0))


def measure_health(health: CameraHealth, frames: Mapping[str, Floats]) -> Floats:
    """Return the health of each camera over time, (bins, cameras, `HEALTH_MEASURES`).

    Args:
        health: departures of the cameras.
        frames: by name, measures (frames, cameras) of single frames; a bin has their mean.
    """
    bins = len(health.matrix)
    out = np.full((bins, health.matrix.shape[1], len(HEALTH_MEASURES)), np.nan)
    out[..., :3] = health.over_time()
    for name, values in frames.items():
        padded = np.full((bins * health.length, values.shape[1]), np.nan)
        padded[: len(values)] = values
        known = np.isfinite(padded).reshape(bins, health.length, -1)
        total = np.nan_to_num(padded).reshape(known.shape).sum(axis=1)
        with np.errstate(invalid="ignore"):
            out[..., HEALTH_MEASURES.index(name)] = total / known.sum(axis=1)
    return out
