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


class CameraGates:
    """Distances of each camera's detections to the people with whom they were matched.

    Attributes:
        usual: (cameras,) medians [m]; infinite where too few are known.
    """

    def __init__(self, cameras: int) -> None:
        self.usual = np.full(cameras, np.inf)
        self._known: list[deque[float]] = [deque(maxlen=MEMORY) for _ in range(cameras)]

    def learn(self, distance: NDArray[np.float64]) -> None:
        """Take in the ray distances (cameras, persons) [m] of a frame's matches; NaN = none."""
        for camera, known in enumerate(self._known):
            known.extend(distance[camera][np.isfinite(distance[camera])].tolist())
            if len(known) >= ENOUGH:
                self.usual[camera] = np.median(known)
