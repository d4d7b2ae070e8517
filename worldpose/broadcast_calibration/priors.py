"""Conversion of the prior settings to the parameters of a clip's frames."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.solving import Prior

REFERENCE: Final = 2.19
"""Reference focal length of the prior's distortion, in image widths [1]."""


def prior_of(
    settings: BroadcastPrior, focal: NDArray[np.float64], image_size: NDArray[np.int64]
) -> Prior:
    """Return the prior of frames with given approximate focal lengths.

    Args:
        settings: middles and spreads.
        focal: (frames,) [px], approximate.
        image_size: (2,) width, height [px].
    """
    width = float(image_size[0])
    middle = 0.5 * (image_size - 1.0)
    zoom = focal / (REFERENCE * width)
    growth = np.stack([zoom**1.6, zoom, zoom], axis=-1)
    spread = np.array([settings.k1_spread, settings.k2_spread, settings.k3_spread])
    return Prior(
        center=np.array(settings.center),
        center_information=np.diag(1.0 / np.square(settings.center_spread)),
        principal_point=middle + width * np.array(settings.principal_point),
        principal_spread=width * np.array(settings.principal_point_spread),
        log_focal=np.full(len(focal), np.log(settings.focal * width)),
        focal_spread=settings.focal_spread,
        distortion=growth * np.array([settings.k1, settings.k2, 0.0]),
        distortion_spread=growth * spread,
    )
