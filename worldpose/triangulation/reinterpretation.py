"""Other readings of a calibration by which no two cameras agree on their people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from data_contracts.arrays import Floats
from data_contracts.cameras import CameraCalibration
from data_contracts.keypoints import KeypointDetections
from worldpose.errors import InputError
from worldpose.formats.calibration_unit import scaled
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid

_FLIP: Final = np.diag([1.0, -1.0, -1.0])
_OTHER_POSES: Final[Mapping[str, Callable[[Rigid], Rigid]]] = {
    "the poses are those of the cameras in the world, not the other way: invert them": (
        lambda pose: pose.inverse()
    ),
    "R is transposed: its columns are the camera's axes in the world: transpose R": (
        lambda pose: Rigid(np.swapaxes(pose.rotation, -1, -2), pose.translation)
    ),
    "t is the cameras' centres in the world: write -R t": (
        lambda pose: Rigid(pose.rotation, -(pose.rotation @ pose.translation[..., None])[..., 0])
    ),
    "the cameras' y axes point up and z backward, as OpenGL's: turn R and t by diag(1, -1, -1)": (
        lambda pose: Rigid(_FLIP @ pose.rotation, pose.translation @ _FLIP)
    ),
    "the poses are those of OpenGL's cameras in the world: invert them, then turn them by "
    "diag(1, -1, -1)": (
        lambda pose: Rigid(_FLIP @ pose.inverse().rotation, pose.inverse().translation @ _FLIP)
    ),
}
"""What files that break their form's rules have in place of poses."""
_SCALES: Final = (1 / 4, 1 / 3, 3 / 8, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 8 / 3, 3.0, 4.0)
"""Ratios of usual image sizes."""


def reinterpret_calibration(
    calibration: Path,
    cameras: Mapping[str, CameraCalibration],
    detections: KeypointDetections,
    agree: Callable[[Camera], bool],
) -> tuple[Mapping[str, CameraCalibration], list[str]]:
    """Return cameras for images of another size if people agree at it alone, and what was done.

    By the cameras of the file, no two of them agree on their people (frames, cameras, detections).
    `agree` says whether people agree in a batch of cameras. InputError if they do when the poses
    mean something else than the form says.
    """

    def stack(given: Mapping[str, CameraCalibration]) -> Camera:
        return Camera.stack([Camera.from_calibration(each) for each in given.values()])

    batch = stack(cameras)
    for why, change in _OTHER_POSES.items():
        other = replace(batch, cam_from_world=change(batch.cam_from_world))
        if agree(other):
            raise InputError(
                f"{calibration}: rotation and translation",
                expected="x_cam = R x_world + t, with y down and z forward",
                found="poses by which no two cameras agree on their people",
                todo=f"They agree if {why}.",
            )
    swap = np.eye(3)[[1, 0, 2]]
    pose = batch.cam_from_world
    other = replace(
        batch,
        focal=batch.focal[..., ::-1],
        distortion=batch.distortion[..., [0, 1, 3, 2, 4, 5, 6, 7]],
        principal_point=batch.principal_point[..., ::-1],
        image_size=batch.image_size[..., ::-1],
        cam_from_world=Rigid(swap @ pose.rotation, pose.translation @ swap),
    )
    if agree(other):
        said = "points on which cameras agree alone if x and y are exchanged"
        raise InputError("2D poses", "x, y of each point", said, "Write x first, then y.")
    reach = _reach(detections)
    found = {}
    for scale in _SCALES:
        sizes = [np.rint(scale * np.array(camera.image_size)) for camera in cameras.values()]
        if (reach > sizes).any():
            continue
        resized = {
            name: scaled(camera, scale, (int(size[0]), int(size[1])))
            for (name, camera), size in zip(cameras.items(), sizes, strict=True)
        }
        if agree(stack(resized)):
            found[scale] = resized
    if len(found) != 1:
        scales = " and ".join(f"{scale:.5f}" for scale in found)
        said = f"warning: no two cameras agree on their people, but do if scaled by {scales}: give "
        return cameras, [said + "a calibration of the 2D poses' images"] if found else []
    ((scale, resized),) = found.items()
    shown = dict.fromkeys("{} x {}".format(*camera.image_size) for camera in resized.values())
    said = f"the calibration is scaled by {scale:.5f}, to images of {' and '.join(shown)} px: "
    return resized, [said + "of the usual ratios of image sizes, this alone fits the 2D poses"]


def _reach(detections: KeypointDetections) -> Floats:
    """Return how far right and down keypoints are in each camera (cameras, 2) [px]; 0 = none."""
    inside = 0.98  # share of keypoints within the image [1]
    reach = np.zeros((detections.keypoints.shape[1], 2))
    for camera in range(len(reach)):
        known = np.isfinite(detections.confidence[:, camera])
        if known.any():
            reach[camera] = np.quantile(detections.keypoints[:, camera][known], inside, axis=0)
    return reach
