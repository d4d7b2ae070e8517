"""Priors of a clip's cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from data_contracts.arrays import Floats, Integers
from worldpose.broadcast_calibration.settings import BroadcastPrior

LENS_POWERS: Final = np.array([1.6, 1.0, 1.0])
"""Powers of the focal length that k1, k2 and k3 of a zoom lens grow with."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior of a clip's camera.

    Attributes:
        center: (3,) [m], world.
        center_information: (3, 3) [1/m^2].
        principal_point: (2,) [px].
        principal_std: (2,) [px].
        log_focal: (frames,) mean of the logarithm of the focal length [px].
        log_focal_std: (frames,), or one for all: deviation of this logarithm in a frame.
        distortion: (frames, 3).
        distortion_std: (frames, 3).
        rotation: (frames, 3, 3) of x_cam = R (x_world - center).
        rotation_std: (frames,) standard deviation of a turn about each axis [rad]; infinite =
            nothing is known.
    """

    center: Floats
    center_information: Floats
    principal_point: Floats
    principal_std: Floats
    log_focal: Floats
    log_focal_std: Floats | float
    distortion: Floats
    distortion_std: Floats
    rotation: Floats | None = None
    rotation_std: Floats | None = None


def build_prior(settings: BroadcastPrior, focal: Floats, image_size: Integers) -> Prior:
    """Return the prior of frames with given approximate focal lengths (frames,) [px].

    All frames have one lens: its departure from the prior lasts for the whole clip, so that the
    frames count as one together, however many there are.
    """
    reference = 2.19  # reference focal length of the prior's distortion, in image widths [1]
    width = float(image_size[0])
    middle = 0.5 * (image_size - 1.0)
    zoom = focal / (reference * width)
    growth = zoom[:, None] ** LENS_POWERS
    spread = np.array([settings.k1_std, settings.k2_std, settings.k3_std])
    return Prior(
        center=np.array(settings.center_m),
        center_information=np.diag(1.0 / np.square(settings.center_std_m)),
        principal_point=middle + width * np.array(settings.principal_point),
        principal_std=width * np.array(settings.principal_point_std),
        log_focal=np.full(len(focal), np.log(settings.focal * width)),
        log_focal_std=settings.log_focal_std * float(np.sqrt(len(focal))),
        distortion=growth * np.array([settings.k1, settings.k2, 0.0]),
        distortion_std=growth * spread * np.sqrt(len(focal)),
    )


def lens_walk(focal: Floats) -> Floats:
    """Return the deviation (frames - 1,) of changes of the distortion [deviations of its prior].

    Over a factor e of the focal lengths (frames,) [px], the distortion departs from its growth with
    the zoom by one deviation of the prior of one lens; a lens at rest does not change.
    """
    zoomed = np.abs(np.diff(np.log(focal)))
    return np.asarray(np.sqrt((zoomed + 1e-6) / len(focal)))
