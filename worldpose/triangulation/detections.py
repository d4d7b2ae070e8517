"""Detections of tracked people: read in chunks of frames, checked, and shifted to one clock."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from data_contracts.arrays import ClipArray, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from worldpose.errors import InputError
from worldpose.geometry import Camera

CHUNK: Final = 512
"""Frames per chunk: some hundred megabytes with 25 people in 16 cameras."""


def read_frames(
    detections: KeypointDetections[ClipArray], frames: slice | Integers, late: Floats | None
) -> KeypointDetections:
    """Return the detections of some frames of a clip, on the common clock.

    Args:
        detections: of the clip, as detected.
        frames: from a first frame to before a last one, or single frames.
        late: (cameras,) [frame], clock offsets to correct; None = no correction.
    """
    offsets = np.zeros(1) if late is None else np.nan_to_num(late)
    reach = math.ceil(float(np.abs(offsets).max(initial=0.0)))
    if not reach:
        return detections[frames]
    if isinstance(frames, slice):
        start = max(0, frames.start - reach)
        shifted = shift_in_time(detections[start : frames.stop + reach], offsets)
        return shifted[frames.start - start : frames.stop - start]
    each = [read_frames(detections, slice(frame, frame + 1), late) for frame in frames.tolist()]
    if not each:
        return read_frames(detections, slice(0, 0), late)
    return KeypointDetections.from_keypoints(
        np.concatenate([one.keypoints for one in each]),
        np.concatenate([one.confidence for one in each]),
        np.concatenate([one.detection_index for one in each]),
    )


def shift_in_time(detections: KeypointDetections, late: Floats) -> KeypointDetections:
    """Return the detections shifted to the common clock, one per person and camera.

    Keypoints are interpolated linearly between two frames and are missing unless both have them.

    Args:
        detections: as detected.
        late: (cameras,) [frame]; NaN or 0 leaves a camera as it is.

    Returns:
        Keypoints (frames, cameras, persons, joints, 2), confidence, and the matching index.
    """
    frames, _, persons = detections.detection_index.shape
    at = np.maximum(detections.detection_index, 0).astype(np.int64)[..., None]
    there = (detections.detection_index >= 0)[..., None]
    pixels = np.take_along_axis(detections.keypoints, at[..., None], axis=2).astype(np.float64)
    weights = np.take_along_axis(detections.confidence, at, axis=2).astype(np.float64)
    weights = np.where(there & np.isfinite(pixels).all(axis=-1), weights, np.nan)
    for camera in np.flatnonzero(np.nan_to_num(late)):
        time = np.arange(frames) - late[camera]
        before = np.floor(time).astype(np.int64)
        share = time - before
        # A whole number of frames needs one frame only.
        after = np.where(share > 0.0, before + 1, before)
        outside = (before < 0) | (after >= frames)
        before, after = np.clip(before, 0, frames - 1), np.clip(after, 0, frames - 1)
        for array, spread in ((pixels, 3), (weights, 2)):
            part = share.reshape(-1, *(1,) * spread)
            of = array[:, camera]
            moved = (1.0 - part) * of[before] + part * of[after]
            moved[outside] = np.nan
            array[:, camera] = moved
    seen = np.isfinite(weights).any(axis=-1)
    index = np.where(seen, np.arange(persons), -1).astype(np.int16)
    return KeypointDetections.from_keypoints(pixels, weights, index)


def check_shapes(
    cameras: Camera, detections: KeypointDetections, camera_covariance: Floats | None
) -> None:
    """Require arrays of matching shapes, and valid indices.

    Raises:
        InputError: they do not match.
    """
    keypoints, confidence = detections.keypoints, detections.confidence
    detection_index = detections.detection_index
    if (
        confidence.ndim != 4
        or keypoints.shape != (*confidence.shape, 2)
        or detection_index.ndim != 3
        or detection_index.shape[:2] != confidence.shape[:2]
        or cameras.batch_shape != confidence.shape[1:2]
    ):
        raise InputError(
            "triangulation",
            expected="keypoints (frames, cameras, detections, joints, 2), confidence without the "
            "last, detection_index (frames, cameras, persons), cameras (cameras,)",
            found=f"{keypoints.shape}, {confidence.shape}, {detection_index.shape}, "
            f"{cameras.batch_shape}",
            todo="Give arrays of the same clip and cameras.",
        )
    if camera_covariance is not None and camera_covariance.shape != (*cameras.batch_shape, 12, 12):
        raise InputError(
            "triangulation: camera_covariance",
            expected=f"shape {(*cameras.batch_shape, 12, 12)}",
            found=f"{camera_covariance.shape}",
            todo="Give the covariance of every camera's calibration, or none.",
        )
    detections = confidence.shape[2]
    if (
        detection_index.size
        and not -1 <= detection_index.min() <= detection_index.max() < detections
    ):
        raise InputError(
            "triangulation: detection_index",
            expected=f"-1 or the place of one of {detections} detections",
            found=f"{detection_index.min()} to {detection_index.max()}",
            todo="Give the index that was made from these detections.",
        )
