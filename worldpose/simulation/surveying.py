"""Survey of the pitch, with measurement errors."""

from __future__ import annotations

import numpy as np

from data_contracts.pitch import PitchSpec
from worldpose.pitch import PitchTemplate


def survey(painted: PitchSpec, error: float, rng: np.random.Generator) -> PitchSpec:
    """Return the pitch with all its points as measured, to a millimetre.

    Args:
        painted: the true pitch.
        error: of a point, standard deviation along each axis [m].
        rng: the surveyor's own.
    """
    points = {}
    for name, place in PitchTemplate.from_spec(painted).points.items():
        x, y, z = (place + error * rng.standard_normal(3)).round(3) + 0.0
        points[name] = (float(x), float(y), float(z))
    return painted.model_copy(update={"points": points})
