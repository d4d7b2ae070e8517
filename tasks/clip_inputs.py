"""A clip as tracking and triangulation see it: all static cameras, one clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_contracts.run import Work
from tasks.unit import open_input
from worldpose.cameras import Camera
from worldpose.cameras.stored import camera_from_arrays
from worldpose.store import Store


@dataclass(frozen=True)
class ClipInputs:
    """Observations of one clip.

    Attributes:
        camera_ids: in the order of every camera dimension.
        cameras: (cameras,) batch.
        camera_covariance: (cameras, 12, 12) of a step of each; None where not all are known.
        frame: (frames,) match frames.
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17); NaN where not found.
        fps: frames a second of match time.
    """

    camera_ids: tuple[str, ...]
    cameras: Camera
    camera_covariance: NDArray[np.float64] | None
    frame: NDArray[np.int64]
    keypoints: NDArray[np.float64]
    confidence: NDArray[np.float64]
    fps: float


def open_clip(store: Store, work: Work) -> ClipInputs:
    """The clip of `work`, with every camera's detections padded to the same number."""
    sources = work.recipe.sources
    camera_ids = tuple(sources["cameras"])
    first, count = sources["first_frame"], sources["frame_count"]
    frame = np.arange(first, first + count)
    clips = [open_input(store, work, f"ingest/{camera}").sel(frame=frame) for camera in camera_ids]
    cameras = [open_input(store, work, f"static_calibration/{camera}") for camera in camera_ids]
    detections = max(1, *(clip.sizes["detection"] for clip in clips))
    shape = (count, len(camera_ids), detections, clips[0].sizes["joint"])
    keypoints = np.full((*shape, 2), np.nan)
    confidence = np.full(shape, np.nan)
    for index, clip in enumerate(clips):
        present = clip.sizes["detection"]
        keypoints[:, index, :present] = clip["keypoints"].values
        confidence[:, index, :present] = clip["confidence"].values
    known = all("covariance" in camera for camera in cameras)  # a given camera tells none
    return ClipInputs(
        camera_ids=camera_ids,
        cameras=Camera.stack([camera_from_arrays(camera.data_vars) for camera in cameras]),
        camera_covariance=np.stack([c["covariance"].values for c in cameras]) if known else None,
        frame=frame,
        keypoints=keypoints,
        confidence=confidence,
        fps=float(sources["fps"]),
    )
