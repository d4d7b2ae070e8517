"""Nets in ONNX files, run by onnxruntime on one thread: equal images give equal bytes.

Pose estimators are decoded here, detectors in `onnx_detectors`.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import PoseEstimator
from worldpose.errors import InputError

_DTYPES: Final[dict[str, np.dtype[Any]]] = {
    "tensor(int32)": np.dtype(np.int32),
    "tensor(uint8)": np.dtype(np.uint8),
    "tensor(float16)": np.dtype(np.float16),
    "tensor(float)": np.dtype(np.float32),
}
IMAGENET_MEAN: Final = np.array([123.675, 116.28, 103.53], dtype=np.float32)
IMAGENET_STD: Final = np.array([58.395, 57.12, 57.375], dtype=np.float32)
"""Mean and standard deviation of ImageNet, for RTMPose and ViTPose [grey level]."""


class OnnxNet:
    """A net with one image as its input.

    Attributes:
        where: the file, for messages.
        size: width, height of its input [px].
        channels_last: whether it takes (batch, height, width, 3), as TensorFlow has it.
        metadata: what the exporter wrote into the file.
        outputs: shape of each output, with None for dynamic sizes.
    """

    def __init__(self, file: Path, device: str, default_size: tuple[int, int]) -> None:
        """Load a file as `open_session`; `default_size`, width, height [px], is for nets of any."""
        self.where = str(file)
        self._session = open_session(file, device)
        inputs = self._session.get_inputs()
        shape = [n if isinstance(n, int) and n > 0 else None for n in inputs[0].shape]
        # Names of a second input for the width and height of the image [px].
        sizes = inputs[1:] and inputs[1].name in ("orig_target_sizes", "target_sizes")
        if len(inputs) > 1 + bool(sizes) or len(shape) != 4 or 3 not in (shape[1], shape[3]):
            raise InputError(
                self.where,
                expected="one input, a batch of images with 3 channels",
                found=f"{len(inputs)} inputs, the first of shape {inputs[0].shape}",
                todo="Export the net without further inputs.",
            )
        if shape[0] not in (None, 1) or inputs[0].type not in _DTYPES:
            raise InputError(
                self.where,
                expected=f"a batch of 1 or of any size, of {', '.join(_DTYPES)}",
                found=f"an input of shape {inputs[0].shape}, {inputs[0].type}",
                todo="Export the net with batch 1 and float32.",
            )
        self._names = [each.name for each in inputs]
        self.channels_last = shape[3] == 3
        height, width = shape[1:3] if self.channels_last else shape[2:4]
        self.size = (width or default_size[0], height or default_size[1])
        self.dtype: np.dtype[Any] = _DTYPES[inputs[0].type]
        self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
        self.outputs = [
            tuple(side if isinstance(side, int) else None for side in output.shape)
            for output in self._session.get_outputs()
        ]

    def run(self, images: NDArray[Any]) -> list[NDArray[Any]]:
        """Return all outputs for images (batch, height, width, 3), in the range that the net takes.

        The result of an image must not depend on its neighbours: each runs alone.
        """
        each = []
        for image in images:
            given = image if self.channels_last else np.moveaxis(image, -1, 0)
            batch = np.ascontiguousarray(given[None].astype(self.dtype))
            inputs = dict(zip(self._names, (batch, np.array([self.size])), strict=False))
            each.append(self._session.run(None, inputs))
        return [np.concatenate(parts) for parts in zip(*each, strict=True)]


def open_session(file: Path, device: str) -> Any:  # noqa: ANN401
    """Return an onnxruntime session of one thread on `cpu` or `cuda`.

    InputError if onnxruntime or a GPU for it is missing, or the file is no net.
    """
    where = str(file)
    runtime = import_library("onnxruntime", where)
    provider = "CUDAExecutionProvider" if device == "cuda" else "CPUExecutionProvider"
    if provider not in runtime.get_available_providers():
        raise InputError(
            where,
            expected="onnxruntime with a GPU",
            found=", ".join(runtime.get_available_providers()),
            todo="Install onnxruntime-gpu, or set detection.device=cpu.",
        )
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return runtime.InferenceSession(str(file), options, providers=[provider])
    except MemoryError:
        raise
    except Exception as error:  # onnxruntime's errors have no common class
        raise InputError(
            where,
            expected="a net in an ONNX file",
            found=str(error).splitlines()[0][:200],
            todo="Export the net again.",
        ) from error


def import_library(name: str, where: str) -> ModuleType:
    """Return a library that computes nets; InputError if it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            where,
            expected=f"{name}, which computes this net",
            found="it is not installed",
            todo='Install it: pip install "worldpose[detectors]".',
        ) from error


def load_onnx_pose(file: Path, device: str = "cpu") -> PoseEstimator:
    """Return a pose estimator from an ONNX file, on `cpu` or `cuda`; errors as of `open_session`.

    The shape of the outputs decides how they are read: (batch, 1, 17, 3) of MoveNet, y, x and score
    in 0..1; two outputs (batch, 17, n) of RTMPose, a score for every column and row; (batch, 17,
    height, width) heat maps. Crops are RGB, 0..255 for MoveNet, else normalized as ImageNet.
    """
    # Input size for a net that takes any size [px].
    net = OnnxNet(file, device, (192, 256))
    shape = net.outputs[0] if net.outputs else ()
    single = len(shape) == 4 and shape[2:] == (17, 3)
    columns = len(net.outputs) == 2 and all(len(o) == 3 and o[1] == 17 for o in net.outputs)
    maps = len(shape) == 4 and shape[1] == 17
    if not (single or columns or maps):
        raise InputError(
            net.where,
            expected="(batch, 1, 17, 3), twice (batch, 17, n), or (batch, 17, height, width)",
            found=f"outputs of shapes {', '.join(str(each) for each in net.outputs)}",
            todo="Export the net in one of these forms.",
        )
    return _OnnxPose(net, normal=not single)


class _OnnxPose:
    """A pose estimator that takes one person per crop."""

    def __init__(self, net: OnnxNet, *, normal: bool) -> None:
        self._net, self._normal = net, normal

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box."""
        if not len(boxes):
            return KeypointDetections.empty()
        # Late: OpenCV takes 0.2 s, and planning a run does not need it.
        from worldpose.detection.crops import crops_around, cut_crop, frame_from_crop

        size = self._net.size
        mappings = frame_from_crop(crops_around(boxes, size), size)
        crops: Image | Singles = np.stack([cut_crop(image, each, size, 0) for each in mappings])
        if self._normal and not np.issubdtype(self._net.dtype, np.integer):  # else it converts
            crops = (crops.astype(np.float32) - IMAGENET_MEAN) / IMAGENET_STD
        outputs = [output.astype(np.float64) for output in self._net.run(crops)]
        points, confidence = _read_keypoints(outputs, size)
        found = confidence > 0.0
        points = points * mappings[:, None, 0, :1] + mappings[:, None, :, 2]
        points = np.where(found[..., None], points, np.nan)
        return KeypointDetections.from_keypoints(
            points, np.where(found, np.minimum(confidence, 1.0), np.nan)
        )


def _read_keypoints(outputs: list[Floats], size: tuple[int, int]) -> tuple[Floats, Floats]:
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
    """Return the subcell peak of maps (boxes, 17, rows, columns), and its height.

    Neighbour cells tell it; `size` is width, height of the crop [px].
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
