"""Triangulation with `method=paper`, in the records of this stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from data_contracts.arrays import Floats
from data_contracts.conventions import COCO17_HIPS
from data_contracts.keypoints import KeypointDetections
from worldpose.geometry.cameras import Camera
from worldpose.reference_method.cameras import TensorCameras
from worldpose.reference_method.reprojection import triangulate, triangulate_about_mid_hip
from worldpose.triangulation.results import Smoothing, Triangulation


def replace_joints(
    cameras: Camera,
    detections: KeypointDetections,
    found: Triangulation,
    smooth: Smoothing,
    *,
    about_mid_hip: bool,
) -> tuple[Triangulation, Smoothing]:
    """Return both results with the paper's joints, each frame on its own and all views alike.

    Joints that we do not determine stay missing. The paper has no covariance: ours stays. Our
    joints `found` are the start; if `about_mid_hip`, the images of a person are shifted until
    mid-hips meet.
    """
    joints = place_joints(cameras, detections, found.joints, about_mid_hip=about_mid_hip)
    unfilled = np.zeros_like(smooth.filled)
    return (
        replace(found, joints=joints),
        replace(smooth, joints=joints, covariance=found.covariance, filled=unfilled),
    )


def place_joints(
    cameras: Camera, detections: KeypointDetections, start: Floats, *, about_mid_hip: bool
) -> Floats:
    """Return the paper's joints (frames, persons, 17, 3) [m]; see `replace_joints`."""
    # Of all frames and persons (n, 17, cameras, 2).
    keypoints = detections.by_person()[0].astype(np.float64).transpose(0, 2, 3, 1, 4)
    image = torch.tensor(keypoints).flatten(0, 1)
    tensors, first = TensorCameras.of(cameras), torch.tensor(start.reshape(-1, 17, 3))
    if about_mid_hip:
        hips = image[:, COCO17_HIPS].mean(1)
        middle = triangulate(tensors, hips, first[:, COCO17_HIPS].mean(1))
        joints = triangulate_about_mid_hip(tensors, image, first, hips, middle)
    else:
        joints = triangulate(tensors, image.flatten(0, 1), first.flatten(0, 1))
    return joints.reshape(start.shape).numpy()
