"""How near to a tracked person a camera's detection must be, learned from those that were matched.

A fixed gate that suits badly calibrated cameras lets a person whom a camera misses take the
detection of a neighbour. Matched detections tell each camera's usual distance.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

MEMORY: Final = 300
"""Matched detections of a camera from which its usual distance is taken."""
ENOUGH: Final = 10
"""Fewer than these tell nothing."""
RAY_NOISE: Final = (0.03, 0.05, 0.13)
"""Standard deviation of the distance between two rays of one joint: least, while unknown, and
greatest [m]. MVOR's median is 0.05 m, Shelf's 0.02 m."""


class CameraGates:
    """Distances of each camera's detections to the people with whom they were matched.

    Attributes:
        usual: (cameras,) medians [m]; infinite where too few are known.
        usual_pair: median distance of the rays of two detections that are each other's nearest
            [m]; infinite where too few are known.
    """

    def __init__(self, cameras: int) -> None:
        self.usual = np.full(cameras, np.inf)
        self.usual_pair = np.inf
        self._pairs: deque[float] = deque(maxlen=MEMORY)
        self._known: list[deque[float]] = [deque(maxlen=MEMORY) for _ in range(cameras)]

    def learn(self, distance: NDArray[np.float64]) -> None:
        """Take in the ray distances (cameras, persons) [m] of a frame's matches; NaN = none."""
        for camera, known in enumerate(self._known):
            known.extend(distance[camera][np.isfinite(distance[camera])].tolist())
            if len(known) >= ENOUGH:
                self.usual[camera] = np.median(known)

    def learn_pairs(self, distance: NDArray[np.float64]) -> None:
        """Take in ray distances (pairs,) [m] of detections that are each other's nearest."""
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
