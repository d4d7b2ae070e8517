"""Resampling of a method's result from the frame rate of its input to the clip's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats
from worldpose.baselines.result import MethodResult
from worldpose.formats import JointTracks


def resampled(result: MethodResult, seen_fps: float, fps: float) -> MethodResult:
    """Return a result at the frames of a clip, with linear interpolation of joints and boxes.

    The first images of both are simultaneous. If a person is missing in one of the two images
    around a frame, the person is missing in the frame, too.

    Args:
        result: its frames count the images of the method's input.
        seen_fps: frame rate of those images [1/s].
        fps: frame rate of the clip [1/s].
    """
    if seen_fps == fps or not len(result.joints.frames):
        return result
    own = result.joints.frames
    # A rounding error must not drop the last frame.
    first = int(np.ceil(own[0] * fps / seen_fps - 1e-6))
    last = int(np.floor(own[-1] * fps / seen_fps + 1e-6))
    frames = np.arange(first, last + 1)
    places = np.clip(frames * seen_fps / fps, own[0], own[-1])
    joints = _between(result.joints.joints, own, places)
    boxes = None if result.boxes is None else _between(result.boxes, own, places)
    said = f"from {seen_fps:g} to {fps:g} pictures a second, on straight lines"
    return replace(
        result,
        joints=JointTracks(frames, result.joints.person_ids, joints),
        boxes=boxes,
        notes={**result.notes, "resampled": said},
    )


def _between(values: Floats, own: NDArray[np.int64], places: Floats) -> Floats:
    """Interpolate values (images, ...) at positions [images]; NaN if a neighbour is missing."""
    before = np.floor(places + 1e-6).astype(np.int64)
    share = np.clip(places - before, 0.0, 1.0)
    share[share < 1e-6] = 0.0
    one, two = (_rows(values, own, number) for number in (before, before + (share > 0.0)))
    weight = share.reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((1.0 - weight) * one + weight * two)


def _rows(values: Floats, own: NDArray[np.int64], wanted: NDArray[np.int64]) -> Floats:
    rows = np.minimum(np.searchsorted(own, wanted), len(own) - 1)
    found = values[rows]
    found[own[rows] != wanted] = np.nan
    return found
