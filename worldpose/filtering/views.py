"""Fitted bodies as every static camera should see them, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.body_fitting.shared_bias import body_axes
from worldpose.cameras import Camera

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BodyViews:
    """Projected bodies, (frames, cameras, persons, 17) each."""

    image: Floats
    """(..., 2) [px]; NaN where there is no body, or it is not before the camera."""
    variance: Floats
    """Of `image` [px^2], mean over both axes: how well the joint is known across the view."""
    scale: Floats
    """How large a metre is there [px/m]."""


def perceived_joints(joints: Floats, offsets: Floats) -> Floats:
    """Return where a detector sees the joints (frames, persons, 17, 3) of bodies [m], world.

    Args:
        joints: (frames, persons, 17, 3) [m], world.
        offsets: (17, 3) [m] from a joint to what is taken for it: forward, left, up.
    """
    moved: Floats = joints + np.einsum("fpab,jb->fpja", body_axes(joints), offsets)
    return moved


def perceived_covariance(covariance: Floats, common_bias: Floats) -> Floats:
    """Return how sure it is where a detector sees the joints of bodies (frames, persons, 17, 3, 3).

    What it takes for a joint is followed by the offsets, however far from the joint that is.

    Args:
        covariance: (frames, persons, 17, 3, 3) [m^2], of the bodies' joints.
        common_bias: (17,) per axis, of what all views err in common [m]; in `covariance`.
    """
    seen: Floats = covariance - common_bias[:, None, None] ** 2 * np.eye(3)
    return seen


def view_bodies(cameras: Camera, joints: Floats, covariance: Floats) -> BodyViews:
    """Return bodies in all pictures.

    Args:
        cameras: batch (cameras,).
        joints: (frames, persons, 17, 3) [m], world, where the detector sees joints; NaN without a
            body.
        covariance: (frames, persons, 17, 3, 3) [m^2].
    """
    frames, persons = joints.shape[:2]
    count = cameras.batch_shape[0]
    shape = (frames, count, persons, joints.shape[2])
    image = cameras.project(joints.reshape(frames, 1, -1, 3)).reshape(*shape, 2)
    ahead = cameras.cam_from_world.rotation[:, 2]
    depth = np.einsum("ca,fpja->fcpj", ahead, joints)
    depth += cameras.cam_from_world.translation[:, 2, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = cameras.focal.mean(axis=-1)[:, None, None] / depth
    total = np.einsum("...aa", covariance)[:, None]
    along = np.einsum("ca,fpjab,cb->fcpj", ahead, covariance, ahead)
    # A picture's axis of view stands for each line of sight in it: of the variance across it, that
    # is off by the square of the sine between them.
    variance = 0.5 * (total - along) * scale**2
    return BodyViews(image, variance, scale)
