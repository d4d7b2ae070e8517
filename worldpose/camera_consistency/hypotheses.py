"""Hypotheses about a camera's fault, each with a correction of its calibration or images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from data_contracts.arrays import Floats, Integers
from data_contracts.camera_consistency import FaultKind
from data_contracts.conventions import COCO17_FLIP, DISTORTION, OTHER_UNITS
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import Rigid

LENS_ORDERS: Final = (
    (0, 1, 3, 4, 2),
    (0, 1, 4, 2, 3),
    (0, 1, 2, 4, 3),
    (0, 1, 4, 3, 2),
    (0, 1, 3, 2, 4),
    (2, 3, 0, 1, 4),
    (0, 2, 3, 1, 4),
    (0, 3, 1, 2, 4),
    (1, 0, 2, 3, 4),
    (1, 2, 3, 4, 0),
    (4, 0, 1, 2, 3),
)
"""Possible positions of k1 k2 p1 p2 k3 among the five stated numbers."""
OFF_AXIS: Final = "its direction or the centre of its image is off"
"""What an order of coefficients with larger shifts stands for: no such lens exists."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A possible camera fault, represented by its correction.

    Attributes:
        detail: description for users.
        camera: the corrected calibration; None = as stated.
        mirrored: whether the detections are mirrored back, with left and right swapped.
        upside_down: whether the detections are rotated by 180 degrees.
        value: the estimated number: ratio, frames; None without.
        source: camera whose detections are used; None = its own.
        time: (sampled frames,) the camera's frame at each of them, -1 = none; None = the same
            frame.
    """

    kind: FaultKind
    detail: str
    camera: Camera | None = None
    mirrored: bool = False
    upside_down: bool = False
    value: float | None = None
    source: int | None = None
    time: Integers | None = None

    def correct(self, stated: Floats, size: Integers) -> Floats:
        """Return detections (..., 17, 2) [px] as a correct video would show them."""
        if self.mirrored:
            image = stated[..., COCO17_FLIP, :].copy()
            image[..., 0] = size[0] - 1.0 - image[..., 0]
            return image
        if self.upside_down:
            return np.asarray(size - 1.0 - stated)
        return stated


STATED: Final = Hypothesis("pose", "")
"""A camera as stated."""


def replace_pose(camera: Camera, rotation: Floats, translation: Floats) -> Camera:
    """Return the camera with another pose."""
    return replace(camera, cam_from_world=Rigid(rotation, translation))


def rotate_camera(camera: Camera, rotvec: Floats) -> Camera:
    """Return the camera rotated about its own centre by a rotation vector [rad] of its axes."""
    rotation = Rotation.from_rotvec(rotvec).as_matrix() @ camera.cam_from_world.rotation
    return replace_pose(camera, rotation, -rotation @ camera.center)


def pose_hypotheses(camera: Camera) -> Iterator[Hypothesis]:
    """Yield possible errors of a whole pose: other end, mirrored, units, conventions."""
    rotation, t = camera.cam_from_world.rotation, camera.cam_from_world.translation
    half = np.diag([-1.0, -1.0, 1.0])
    yield Hypothesis("flipped", "", replace_pose(camera, rotation @ half, t))
    for axes, detail in (
        ((-1.0, 1.0, -1.0), "left and right are exchanged in the names"),
        ((1.0, -1.0, -1.0), "near and far are exchanged in the names"),
    ):
        yield Hypothesis("mirrored", detail, replace_pose(camera, rotation @ np.diag(axes), t))
    flip = np.diag([-1.0, 1.0, 1.0])
    for axes, detail in (
        ((-1.0, 1.0, 1.0), "its pose is mirrored left to right"),
        ((1.0, -1.0, 1.0), "its pose is mirrored near to far"),
    ):
        turned = replace_pose(camera, flip @ rotation @ np.diag(axes), flip @ t)
        yield Hypothesis("mirrored", detail, turned)
        # Clicks in a mirrored image fit exchanged names, and a camera at the mirrored place.
        detail = "its images are mirrored, and so are the names of its clicks"
        yield Hypothesis("mirrored", detail, turned, mirrored=True)
    yield Hypothesis("mirrored", "its images are mirrored", mirrored=True)
    yield Hypothesis("pose", "its images are upside down", upside_down=True)
    yield Hypothesis(
        "pose",
        "the pose is that of the camera in the world",
        replace_pose(camera, rotation.T, -rotation.T @ t),
    )
    yield Hypothesis(
        "pose",
        "the translation is the camera's position",
        replace_pose(camera, rotation, -rotation @ t),
    )
    opengl = np.diag([1.0, -1.0, -1.0])
    yield Hypothesis(
        "pose", "y points up and z backwards", replace_pose(camera, opengl @ rotation, opengl @ t)
    )
    for unit, scale in OTHER_UNITS.items():
        yield Hypothesis(
            "pose", f"the position is in {unit}", replace_pose(camera, rotation, t * scale)
        )
    rotvec = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(rotvec))
    if angle > 1e-9:
        axis = rotvec / angle
        for turns in range(-29, 30):
            degrees = angle + 2.0 * math.pi * turns
            if 6.0 < abs(degrees) <= 181.0:
                rotated = Rotation.from_rotvec(axis * math.radians(degrees)).as_matrix()
                yield Hypothesis(
                    "pose", "the rotation is in degrees", replace_pose(camera, rotated, t)
                )


def lens_hypotheses(camera: Camera) -> Iterator[Hypothesis]:
    """Yield possible misreadings of lens coefficients: other order, inverted, absent, fisheye.

    Orders with large tangential coefficients move the image nearly as a whole: they show an error
    of the principal point or the orientation.
    """
    # Largest shift of an image corner by p1 and p2 of a real lens, relative to the image
    # width [1]. The four cameras of Pose2Sim's demo have 0.0007 to 0.002.
    max_tangential = 0.01
    stated = camera.distortion
    tried = [stated]
    choices = [
        (-stated, "the coefficients have the opposite sign"),
        (np.zeros(len(stated)), "the images have no distortion"),
    ]
    if camera.lens_model == LensModel.BROWN:
        for order in LENS_ORDERS:
            names = " ".join(np.array(DISTORTION[:5])[np.argsort(order)])
            said = f"the coefficients stand in the order {names}"
            choices.append((np.append(stated[list(order)], np.zeros(3)), said))
        if stated.any():
            # k1 to k4 of a fisheye, read as k1 k2 p1 p2.
            fisheye = np.array([*stated[:2], 0.0, 0.0, *stated[2:4], 0.0, 0.0])
            lens = replace(camera, distortion=fisheye, lens_model=LensModel.FISHEYE)
            yield Hypothesis("lens", "the coefficients are those of a fisheye", lens)
    for values, detail in choices:
        if not any(np.array_equal(values, other) for other in tried):
            tried.append(values)
            if tangential_shift(camera, values) > max_tangential:
                detail = OFF_AXIS
            yield Hypothesis("lens", detail, replace(camera, distortion=values))


def tangential_shift(camera: Camera, distortion: Floats) -> float:
    """Return the largest shift of an image corner by p1 and p2, relative to the width [1]."""
    p1, p2 = distortion[2:4]
    width, height = camera.image_size - 1.0
    corners = np.array([(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)])
    x, y = ((corners - camera.principal_point) / camera.focal).T
    squared = x**2 + y**2
    along = 2.0 * p1 * x * y + p2 * (squared + 2.0 * x**2)
    down = p1 * (squared + 2.0 * y**2) + 2.0 * p2 * x * y
    return float((np.hypot(camera.focal[0] * along, camera.focal[1] * down) / width).max())
