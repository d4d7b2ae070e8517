"""What the embedded pose net sees in crops around boxes."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from worldpose.detection.boxes import SUREST
from worldpose.detection.interfaces import Poses

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Look:
    """What crops around boxes show.

    Attributes:
        places: (people, 17, count, 2) where each joint may be, the likeliest first [px].
        mass: (people, 17, count) probability about each place.
        sure: (people, 17, count) chance that a place is right.
        boxes: (people, 4) [px].
        fit: (people,) how much of their union these and the true boxes share, as expected [1].
    """

    places: Floats
    mass: Floats
    sure: Floats
    boxes: Floats
    fit: Floats

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Look:
        """What it sees of some people."""
        return Look(*(getattr(self, field.name)[which] for field in fields(self)))

    def replace(self, which: NDArray[np.bool_], other: Look) -> None:
        """Put what another look shows in the place of some people, in place."""
        for field in fields(self):
            getattr(self, field.name)[which] = getattr(other, field.name)

    @property
    def score(self) -> Floats:
        """How sure it is that somebody is there (people,): fit times surest keypoints [1]."""
        surest = np.sort(self.sure[..., 0], axis=1)[:, -SUREST:].mean(axis=1)
        return np.asarray(self.fit * surest)

    def poses(self, taken: NDArray[np.intp]) -> Poses:
        """The poses whose joints are in the places (people, 17) that are taken."""
        one = taken[..., None]
        return Poses(
            np.take_along_axis(self.places, one[..., None], axis=2)[:, :, 0],
            np.take_along_axis(self.sure, one, axis=2)[:, :, 0],
            self.boxes,
            self.fit,
        )
