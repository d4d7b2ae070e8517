"""One person on the way through a clip: pose, motion, and what was seen of it so far."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from worldpose.tracking.settings import TrackingSettings


@dataclass(frozen=True)
class Sighting:
    """Detections of different views, in one frame, that are one person.

    Attributes:
        index: (cameras,) place among the detections; -1 = not seen.
        ray_distance: (cameras,) mean distance of the detection's rays to the person [m]; NaN =
            not seen.
        joints: (17, 3) [m], world; NaN where the rays do not determine them.
    """

    index: NDArray[np.int64]
    ray_distance: NDArray[np.float64]
    joints: NDArray[np.float64]

    def filled_from(self, other: Sighting) -> Sighting:
        """Return this with the other's detections in the cameras where this has none."""
        own = self.index >= 0
        return Sighting(
            np.where(own, self.index, other.index),
            np.where(own, self.ray_distance, other.ray_distance),
            np.where(np.isfinite(self.joints), self.joints, other.joints),
        )


@dataclass(eq=False)
class Person:
    """The state of one track, changed frame by frame.

    Attributes:
        number: order of birth.
        pose: (17, 3) [m], world, at the current frame; NaN for joints never determined.
        last_fixed: last frame whose rays determined the place.
        velocity: (3,) [m/s], of the whole body.
        sightings: by frame.
        fixed: number of frames whose rays determined the place.
    """

    number: int
    pose: NDArray[np.float64]
    last_fixed: int
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    sightings: dict[int, Sighting] = field(default_factory=dict)
    fixed: int = 0

    def advance(self, frame: int, fps: float, settings: TrackingSettings) -> None:
        """Move the pose on to `frame`, one frame later."""
        if settings.predict_motion:
            self.pose = self.pose + self.velocity / fps
            if self.last_fixed < frame - 1:
                self.velocity = self.velocity * math.exp(-1.0 / (fps * settings.coast_time))

    def see(self, frame: int, sighting: Sighting, fps: float, settings: TrackingSettings) -> None:
        """Take over what was seen in `frame`; joints not determined follow the others."""
        self.sightings[frame] = sighting
        known = np.isfinite(sighting.joints[:, 0])
        if not known.any():
            return
        both = known & np.isfinite(self.pose[:, 0])
        elapsed = (frame - self.last_fixed) / fps
        if both.any() and elapsed > 0.0:
            shift = np.median((sighting.joints - self.pose)[both], axis=0)
            gain = 1.0 - math.exp(-elapsed / settings.velocity_time)
            self.velocity = self.velocity + gain * shift / elapsed
            self.pose = self.pose + shift
        self.pose = np.where(known[:, None], sighting.joints, self.pose)
        self.last_fixed = frame
        self.fixed += 1

    def absorb(self, other: Person, since: int) -> None:
        """Take over the other's sightings from frame `since` on: they show this person."""
        for frame in [frame for frame in other.sightings if frame >= since]:
            theirs = other.sightings.pop(frame)
            own = self.sightings.get(frame)
            self.sightings[frame] = theirs if own is None else own.filled_from(theirs)
            other.fixed -= bool(np.isfinite(theirs.joints).any())


def separations(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean distance of the joints known in both poses of every pair [m].

    Args:
        a: (n, 17, 3) [m], world.
        b: (m, 17, 3) [m], world.

    Returns:
        (n, m) [m]; infinite where no joint is known in both.
    """
    distances = np.linalg.norm(a[:, None] - b[None], axis=-1)
    known = np.isfinite(distances)
    count = known.sum(axis=-1)
    total = np.where(known, distances, 0.0).sum(axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)
