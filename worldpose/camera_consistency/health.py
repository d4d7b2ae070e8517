"""Health of each camera over time: how its keypoints depart from the people whom all cameras place.

Each bin of frames has the mean robust loss of the departures; the shift of a camera's view and its
clock offset come from the equations in which changes are found (`triangulation.change_parts`).
`measure_health` joins this with what detections and images tell, as `HEALTH_MEASURES` of a clip.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import convolve1d

from data_contracts.arrays import Flags, Floats
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import HEALTH_MEASURES
from worldpose.geometry.cameras import Camera
from worldpose.geometry.optimize.losses import cauchy_loss

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
        sums: (bins, cameras, 2) number of terms, and sum of the robust loss of departures [1].
        missed: (cameras, persons) number of compared frames in which a camera shows all limbs of a
            person and has no detection of it.
    """

    length: int
    every: int
    sums: Floats
    missed: Floats

    @classmethod
    def empty(cls, frames: int, cameras: int, persons: int, fps: float) -> CameraHealth:
        """Return bins of 0.2 s without departures."""
        length = max(1, round(0.2 * fps))
        # More frames cost time and tell little more.
        every = length if frames * cameras * persons > 50_000 else 1
        bins = -(-frames // length)
        return cls(length, every, np.zeros((bins, cameras, 2)), np.zeros((cameras, persons)))

    @property
    def misfit(self) -> Floats:
        """Mean robust loss of each camera's departures (cameras,) [1]; at most 2 if none moves."""
        terms, loss = self.sums.sum(axis=0).T
        return np.asarray(loss / np.maximum(1.0, 2.0 * terms))

    def over_time(self, departures: Floats) -> Floats:
        """Return misfit [1], shift of the view [px] and clock offset [frame] in each bin.

        They are those of the second around it, (bins, cameras, 3); NaN with fewer than 20 terms.
        Shift and offset are given in `departures` (bins, cameras, 2).
        """
        terms, loss = np.moveaxis(convolve1d(self.sums, np.ones(5), axis=0, mode="constant"), -1, 0)
        misfit = loss / np.maximum(1.0, 2.0 * terms)
        found = np.concatenate([misfit[..., None], departures], axis=2)
        found[terms < 20.0] = np.nan
        return found

    def add(
        self,
        cameras: Camera,
        people: KeypointDetections,
        joints: Floats,
        start: int,
        stated: Callable[[Floats], Floats] | None = None,
    ) -> None:
        """Add a chunk of a clip; its first and last frame belong to the neighbours.

        Tracked people are (frames, cameras, detections), triangulated joints (frames, persons, 17,
        3) [m], world; `start` is the row of the first of these frames in the clip. `stated` returns
        the variance per axis by the calibration (frames, cameras, persons) [px^2] at joints: what
        it explains is no misfit; None = it explains nothing.
        """
        rows = np.arange(1, len(joints) - 1)
        rows = rows[(start + rows) % self.every == self.every // 2]
        bins = (start + rows) // self.length
        if not len(rows):
            return
        index = people.detection_index[rows]
        variance = None if stated is None else stated(joints[rows])
        for c in range(index.shape[1]):
            slot = index[:, c]
            frame, person = np.nonzero(slot >= 0)
            pixels = people.keypoints[rows[frame], c, slot[frame, person]][:, LIMBS]
            own = 0.0 if variance is None else variance[frame, c, person][:, None]
            terms = _departures(cameras[c], pixels, joints[rows[frame], person][:, LIMBS], own)
            np.add.at(self.sums[:, c], bins[frame], terms)
            # Before its first and after its last detection, a camera may film nothing.
            seen = np.flatnonzero((people.confidence[rows, c] > 0.0).any(axis=(1, 2)))
            films = np.zeros((len(rows), 1), np.bool_)
            films[seen.min(initial=len(rows)) : seen.max(initial=-1) + 1] = True
            frame, person = np.nonzero((slot < 0) & films)
            shown = _are_shown(cameras[c], joints[rows[frame], person][:, LIMBS])
            np.add.at(self.missed[c], person[shown], 1.0)


def _departures(camera: Camera, pixels: Floats, points: Floats, stated: Floats | float) -> Floats:
    """Return the number of terms and their loss (n, 2) of people (n, 12) at points [m]."""
    joint_noise, pixel_noise = 0.03, 2.0  # of a detector [m], [px]
    image = camera.project(points.reshape(-1, 3)).reshape(pixels.shape)
    depth = camera.cam_from_world.apply(points.reshape(-1, 3))[:, 2].reshape(pixels.shape[:-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = pixel_noise**2 + (joint_noise * camera.focal.mean() / depth) ** 2
        loss = cauchy_loss(((pixels - image) ** 2).sum(axis=-1) / (variance + stated), 5.0)
    use = np.isfinite(loss) & (depth > 0.0)
    return np.stack([use.sum(axis=1), np.where(use, loss, 0.0).sum(axis=1)], axis=-1)


def _are_shown(camera: Camera, points: Floats) -> Flags:
    """Return whether a camera's image has all points of people (n, 12, 3) [m], (n,)."""
    image = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:-1], 2)
    return np.asarray(((image >= 0.0) & (image < camera.image_size)).all(axis=(1, 2)))


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


def measure_health(
    health: CameraHealth, departures: Floats, frames: Mapping[str, Floats]
) -> Floats:
    """Return the health of each camera over time, (bins, cameras, `HEALTH_MEASURES`).

    Args:
        health: misfit of the cameras.
        departures: (bins, cameras, 2) shift of each view [px] and clock offset [frame].
        frames: by name, measures (frames, cameras) of single frames; a bin has their mean.
    """
    bins, cameras = health.sums.shape[:2]
    out = np.full((bins, cameras, len(HEALTH_MEASURES)), np.nan)
    out[..., :3] = health.over_time(departures)
    for name, values in frames.items():
        padded = np.full((bins * health.length, values.shape[1]), np.nan)
        padded[: len(values)] = values
        known = np.isfinite(padded).reshape(bins, health.length, -1)
        total = np.nan_to_num(padded).reshape(known.shape).sum(axis=1)
        with np.errstate(invalid="ignore"):
            out[..., HEALTH_MEASURES.index(name)] = total / known.sum(axis=1)
    return out
