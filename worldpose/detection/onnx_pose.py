"""Pose estimators in ONNX files: MoveNet's single pose, RTMPose, and nets with heat maps."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.crops import crop_frames, cut_crops, in_picture
from worldpose.detection.interfaces import PoseEstimator
from worldpose.detection.onnx_session import OnnxNet, unknown_outputs

CROP_SIZE: Final = (192, 256)
"""Input size for a net that takes any size [px]."""
PADDING: Final = 1.25
"""Size of crops over that of boxes, as in the training of these nets [1]."""
MEAN: Final = np.array([123.675, 116.28, 103.53], dtype=np.float32)
SPREAD: Final = np.array([58.395, 57.12, 57.375], dtype=np.float32)
"""Mean and standard deviation of ImageNet, for RTMPose and ViTPose [grey level]."""


def onnx_pose(file: Path, device: str = "cpu") -> PoseEstimator:
    """Return a pose estimator from an ONNX file.

    The shape of the outputs decides how they are read: (batch, 1, 17, 3) of MoveNet, y, x and
    score in 0..1; two outputs (batch, 17, n) of RTMPose, a score for every column and row; (batch,
    17, height, width) heat maps. Crops are RGB, 0..255 for MoveNet, else normalised as ImageNet.

    Args:
        file: the net.
        device: `cpu` or `cuda`.

    Raises:
        InputError: onnxruntime is not installed, or the file is no such net.
    """
    net = OnnxNet(file, device, CROP_SIZE)
    shape = net.outputs[0] if net.outputs else ()
    single = len(shape) == 4 and shape[2:] == (17, 3)
    columns = len(net.outputs) == 2 and all(len(o) == 3 and o[1] == 17 for o in net.outputs)
    maps = len(shape) == 4 and shape[1] == 17
    if not (single or columns or maps):
        raise unknown_outputs(
            net, "(batch, 1, 17, 3), twice (batch, 17, n), or (batch, 17, height, width)"
        )
    return _OnnxPose(net, normal=not single)


class _OnnxPose:
    """A pose estimator that takes one person per crop."""

    def __init__(self, net: OnnxNet, *, normal: bool) -> None:
        self._net, self._normal = net, normal

    def estimate(self, picture: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box."""
        if not len(boxes):
            return KeypointDetections.empty()
        frames = crop_frames(boxes, self._net.size, PADDING)
        crops: NDArray[np.uint8] | NDArray[np.float32] = cut_crops(picture, frames, self._net.size)
        if self._normal:
            crops = (crops.astype(np.float32) - MEAN) / SPREAD
        outputs = [output.astype(np.float64) for output in self._net.run(crops)]
        points, confidence = _read(outputs, self._net.size)
        found = confidence > 0.0
        points = np.where(found[..., None], in_picture(points, frames), np.nan)
        return KeypointDetections.from_keypoints(
            points, np.where(found, np.minimum(confidence, 1.0), np.nan)
        )


def _read(outputs: list[Floats], size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return points (boxes, 17, 2) in the crop's pixels, and confidences (boxes, 17)."""
    first = outputs[0]
    if len(outputs) == 2:
        return _from_columns(first, outputs[1], size)
    if first.shape[2:] == (17, 3):
        single = first[:, 0]
        # No half pixel: only so do an image and its mirror image agree.
        return single[..., [1, 0]] * size, single[..., 2]
    return from_heat_maps(first, size)


def _from_columns(across: Floats, down: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return RTMPose's points: the best column and row, each a fraction of a pixel."""
    place = np.stack([across.argmax(axis=2), down.argmax(axis=2)], axis=2).astype(np.float64)
    points = place * size / [across.shape[2], down.shape[2]]
    return points, np.minimum(across.max(axis=2), down.max(axis=2))


def from_heat_maps(maps: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Return the subcell peak of each map, from its neighbour cells, and its height.

    Args:
        maps: (boxes, 17, rows, columns).
        size: width, height of the crop [px].
    """
    count, joints, rows, columns = maps.shape
    flat = maps.reshape(count, joints, -1)
    peak = flat.argmax(axis=2)
    x, y = peak % columns, peak // columns
    points = np.stack([x, y], axis=2).astype(np.float64)
    padded = np.pad(maps, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge")
    box, joint = np.ogrid[:count, :joints]
    middle = np.log(np.maximum(padded[box, joint, y + 1, x + 1], 1e-10))
    for axis, (before, after) in enumerate(
        (
            (padded[box, joint, y + 1, x], padded[box, joint, y + 1, x + 2]),
            (padded[box, joint, y, x + 1], padded[box, joint, y + 2, x + 1]),
        )
    ):
        # The vertex of the parabola through three logarithms is a Gaussian's mean.
        left, right = (np.log(np.maximum(side, 1e-10)) for side in (before, after))
        bend = left + right - 2.0 * middle
        shift = np.divide(0.5 * (left - right), bend, out=np.zeros_like(bend), where=bend < -1e-6)
        points[..., axis] += np.clip(shift, -0.5, 0.5)
    cell = np.array(size) / [columns, rows]
    return (points + 0.5) * cell - 0.5, flat.max(axis=2)
