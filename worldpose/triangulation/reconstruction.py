"""Reconstruction stage: clock offsets, joints of every frame, joints of every track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from worldpose.geometry import Camera
from worldpose.triangulation.array_checks import check_arrays
from worldpose.triangulation.chunking import ClipDetections, learn_clip, reconstruct_chunks
from worldpose.triangulation.clocks import CameraClocks
from worldpose.triangulation.robust import Triangulation
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.smoothing import Smoothing


@dataclass(frozen=True)
class Reconstruction:
    """Joints and clock offsets of one clip.

    Attributes:
        triangulation: each frame on its own.
        smoothing: whole tracks.
        clocks: clock offsets; corrected if the settings say so.
    """

    triangulation: Triangulation
    smoothing: Smoothing
    clocks: CameraClocks


def reconstruct_joints(
    cameras: Camera,
    keypoints: NDArray[np.floating],
    confidence: NDArray[np.floating],
    detection_index: NDArray[np.int16],
    fps: float,
    settings: TriangulationSettings,
    camera_covariance: NDArray[np.float64] | None = None,
) -> Reconstruction:
    """Return a clip's triangulated and smoothed joints, and its cameras' clock offsets.

    Args:
        cameras: batch (cameras,).
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17) in (0, 1]; NaN, 0 or less leaves a keypoint
            out.
        detection_index: (frames, cameras, persons), index of the detection; -1 = not seen.
        fps: frames per second [1/s].
        settings: of the stage.
        camera_covariance: (cameras, 12, 12) as in `triangulate_joints`.

    Raises:
        InputError: the shapes do not match.
    """
    check_arrays(cameras, keypoints, confidence, detection_index, camera_covariance)
    detections = ClipDetections(keypoints, confidence, detection_index)
    model, detections = learn_clip(cameras, detections, fps, settings, camera_covariance)
    (whole,) = reconstruct_chunks(
        *(cameras, detections, model, fps, settings, camera_covariance, len(keypoints))
    )
    return Reconstruction(whole.triangulation, whole.smoothing, model.clocks)
