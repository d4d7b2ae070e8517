"""Output of the embedded pose net for crops around boxes."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.boxes import surest_confidence


@dataclass(frozen=True, eq=False)
class Look:
    """Candidate joints, boxes and scores from crops around boxes.

    Attributes:
        places: (people, 17, count, 2) candidate positions of each joint, the likeliest first [px].
        mass: (people, 17, count) probability around each position.
        sure: (people, 17, count) probability that a position is correct.
        boxes: (people, 4) [px].
        fit: (people,) expected intersection over union of these and the true boxes [1].
    """

    places: Floats
    mass: Floats
    sure: Floats
    boxes: Floats
    fit: Floats

    def only(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Look:
        """Return the output for some people."""
        return Look(*(getattr(self, field.name)[which] for field in fields(self)))

    def replace(self, which: NDArray[np.bool_], other: Look) -> None:
        """Overwrite the output of some people with that of another look."""
        for field in fields(self):
            getattr(self, field.name)[which] = getattr(other, field.name)

    @property
    def score(self) -> Floats:
        """Return the confidence that a box holds a person (people,): fit times surest keypoints."""
        return np.asarray(self.fit * surest_confidence(self.sure[..., 0]))

    def poses(self, taken: NDArray[np.intp]) -> KeypointDetections:
        """Return the poses whose joints are at the chosen candidates (people, 17)."""
        one = taken[..., None]
        return KeypointDetections(
            np.take_along_axis(self.places, one[..., None], axis=2)[:, :, 0],
            np.take_along_axis(self.sure, one, axis=2)[:, :, 0],
            self.boxes,
            self.fit,
        )
