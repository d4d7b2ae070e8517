"""Gates on the distance of a camera's detections to tracked people, learned from matches.

If a camera misses a person, a fixed gate wide enough for badly calibrated cameras would admit a
neighbour's detection. The distances of matched detections give each camera's gate.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

MEMORY: Final = 300
"""Most matched detections of a camera that its median distance uses."""
ENOUGH: Final = 10
"""Least number of matches for a median."""
RAY_NOISE: Final = (0.03, 0.05, 0.13)
"""Standard deviation of the distance between two rays of one joint: least, while unknown, and
greatest [m]. MVOR's median is 0.05 m, Shelf's 0.02 m."""


class CameraGates:
    """Distances of each camera's detections to the people that they were matched with.

    Attributes:
        usual: (cameras,) medians [m]; infinite with too few matches.
        usual_pair: median distance of the rays of two detections that are each other's nearest
            [m]; infinite with too few.
    """

    def __init__(self, cameras: int) -> None:
        self.usual = np.full(cameras, np.inf)
        self.usual_pair = np.inf
        self._pairs: deque[float] = deque(maxlen=MEMORY)
        self._known: list[deque[float]] = [deque(maxlen=MEMORY) for _ in range(cameras)]

    def learn(self, distance: NDArray[np.float64]) -> None:
        """Add the ray distances (cameras, persons) [m] of a frame's matches; NaN = none."""
        for camera, known in enumerate(self._known):
            known.extend(distance[camera][np.isfinite(distance[camera])].tolist())
            if len(known) >= ENOUGH:
                self.usual[camera] = np.median(known)

    def learn_pairs(self, distance: NDArray[np.float64]) -> None:
        """Add ray distances (pairs,) [m] of detections that are each other's nearest."""
        self._pairs.extend(distance.tolist())
        if len(self._pairs) >= ENOUGH:
            self.usual_pair = float(np.median(self._pairs))

    def pair_noise(
        self, first: NDArray[np.int64], second: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the standard deviation of the distance of two cameras' rays (n,) [m]."""
        low, unknown, high = RAY_NOISE
        usual = 1.4 * np.hypot(self.usual[first], self.usual[second])
        usual = np.where(np.isfinite(usual), usual, self.usual_pair)
        # The median of Rayleigh's distribution is 1.18 times its scale.
        return np.asarray(np.where(np.isfinite(usual), np.clip(0.85 * usual, low, high), unknown))
