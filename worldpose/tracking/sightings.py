"""Compact storage of a person's detections and joints per frame."""

from __future__ import annotations

from collections.abc import Iterator, MutableMapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

BLOCK: Final = 16
"""Frames stored together: most ghosts need one block, and array headers cost little."""


@dataclass(frozen=True)
class Sighting:
    """Detections of one person in different views of one frame.

    Attributes:
        index: (cameras,) index of the detection; -1 = not seen.
        ray_distance: (cameras,) mean distance of the detection's rays to the person [m]; NaN = not
            seen.
        joints: (17, 3) [m], world; NaN where the rays do not determine them.
    """

    index: NDArray[np.int64]
    ray_distance: NDArray[np.float64]
    joints: NDArray[np.float64]

    def filled_from(self, other: Sighting) -> Sighting:
        """Return this with the other's detections in cameras without one of its own."""
        own = self.index >= 0
        return Sighting(
            np.where(own, self.index, other.index),
            np.where(own, self.ray_distance, other.ray_distance),
            np.where(np.isfinite(self.joints), self.joints, other.joints),
        )


Block = tuple[NDArray[np.int16], NDArray[np.float32], NDArray[np.float32]]


class Sightings(MutableMapping[int, Sighting]):
    """Sightings by frame, in order of insertion; stored as int16 and float32."""

    def __init__(self) -> None:
        self._place: dict[int, int] = {}
        self._blocks: list[Block] = []
        self._used = 0

    def __setitem__(self, frame: int, sighting: Sighting) -> None:
        place = self._place.get(frame, self._used)
        number, row = divmod(place, BLOCK)
        if number == len(self._blocks):
            self._blocks.append(
                (
                    np.empty((BLOCK, *sighting.index.shape), np.int16),
                    np.empty((BLOCK, *sighting.ray_distance.shape), np.float32),
                    np.empty((BLOCK, *sighting.joints.shape), np.float32),
                )
            )
        index, ray_distance, joints = self._blocks[number]
        index[row] = sighting.index
        ray_distance[row] = sighting.ray_distance
        joints[row] = sighting.joints
        self._place[frame] = place
        self._used = max(self._used, place + 1)

    def __getitem__(self, frame: int) -> Sighting:
        number, row = divmod(self._place[frame], BLOCK)
        index, ray_distance, joints = self._blocks[number]
        return Sighting(
            index[row].astype(np.int64),
            ray_distance[row].astype(np.float64),
            joints[row].astype(np.float64),
        )

    def __delitem__(self, frame: int) -> None:
        del self._place[frame]

    def __iter__(self) -> Iterator[int]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)
