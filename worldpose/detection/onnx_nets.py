"""Nets in ONNX files, run by onnxruntime on one thread: equal images give equal bytes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import MIN_SCORE, Detector, People, PoseEstimator
from worldpose.detection.suppression import suppress
from worldpose.errors import InputError

_DTYPES = {
    "tensor(int32)": np.dtype(np.int32),
    "tensor(uint8)": np.dtype(np.uint8),
    "tensor(float16)": np.dtype(np.float16),
    "tensor(float)": np.dtype(np.float32),
}
PERSON: Final = 0
"""Class of people in nets trained on COCO."""
VIEW_SIZE: Final = (640, 640)
"""Input size for a net that takes any size [px]."""
DOUBLES: Final = 0.7
"""Boxes of a raw grid with a larger intersection over union are of one person [1]."""
MULTIPOSE: Final = 56
"""Numbers per person of MoveNet MultiPose: 17 y, x and scores, then the box and its score."""
_FORMS: Final = (
    "(batch, 4 + classes, anchors), (batch, anchors, 5 + classes), (batch, boxes, 6) or "
    "(batch, people, 56)"
)
CROP_SIZE: Final = (192, 256)
"""Input size for a net that takes any size [px]."""
PADDING: Final = 1.25
"""Size of crops over that of boxes, as in the training of these nets [1]."""
MEAN: Final = np.array([123.675, 116.28, 103.53], dtype=np.float32)
SPREAD: Final = np.array([58.395, 57.12, 57.375], dtype=np.float32)
"""Mean and standard deviation of ImageNet, for RTMPose and ViTPose [grey level]."""
Reader = Callable[[NDArray[Any]], People]


class OnnxNet:
    """A net with one image as its input.

    Attributes:
        where: the file, for messages.
        size: width, height of its input [px].
        channels_last: whether it takes (batch, height, width, 3), as TensorFlow has it.
        dtype: of its input.
        batch: images per call; None for any number.
        outputs: shape of each output, with None for dynamic sizes.
    """

    def __init__(self, file: Path, device: str, default_size: tuple[int, int]) -> None:
        """Load a file.

        Args:
            file: the net.
            device: `cpu` or `cuda`.
            default_size: width, height [px] for a net that takes any.

        Raises:
            InputError: onnxruntime or a GPU for it is missing, or the file is no such net.
        """
        self.where = str(file)
        runtime = _import_runtime(self.where)
        provider = "CUDAExecutionProvider" if device == "cuda" else "CPUExecutionProvider"
        if provider not in runtime.get_available_providers():
            raise InputError(
                self.where,
                expected="onnxruntime with a GPU",
                found=", ".join(runtime.get_available_providers()),
                todo="Install onnxruntime-gpu, or set detection.device=cpu.",
            )
        options = runtime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = runtime.InferenceSession(str(file), options, providers=[provider])
        except MemoryError:
            raise
        except Exception as error:  # onnxruntime's errors have no common class
            raise InputError(
                self.where,
                expected="a net in an ONNX file",
                found=str(error).splitlines()[0][:200],
                todo="Export the net again.",
            ) from error
        inputs = self._session.get_inputs()
        shape = [side if isinstance(side, int) else None for side in inputs[0].shape]
        if len(inputs) != 1 or len(shape) != 4 or 3 not in (shape[1], shape[3]):
            raise InputError(
                self.where,
                expected="one input, a batch of images with 3 channels",
                found=f"{len(inputs)} inputs, the first of shape {inputs[0].shape}",
                todo="Export the net without further inputs.",
            )
        self._name = inputs[0].name
        self.channels_last = shape[3] == 3
        self.batch = shape[0]
        height, width = shape[1:3] if self.channels_last else shape[2:4]
        self.size = (width or default_size[0], height or default_size[1])
        self.dtype = _DTYPES.get(inputs[0].type, np.dtype(np.float32))
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
            each.append(self._session.run(None, {self._name: batch}))
        return [np.concatenate(parts) for parts in zip(*each, strict=True)]


def unknown_outputs(net: OnnxNet, expected: str) -> InputError:
    """Return the error for a net with unknown outputs."""
    return InputError(
        net.where,
        expected=expected,
        found=f"outputs of shapes {_list_shapes(net.outputs)}",
        todo="Export the net in one of these forms.",
    )


def _list_shapes(shapes: Sequence[tuple[int | None, ...]]) -> str:
    return ", ".join(str(shape) for shape in shapes)


def _import_runtime(where: str) -> ModuleType:
    try:
        runtime: ModuleType = import_module("onnxruntime")
    except ImportError as error:
        raise InputError(
            where,
            expected="onnxruntime, which runs ONNX files",
            found="it is not installed",
            todo='Install it: pip install "worldpose[detectors]".',
        ) from error
    return runtime


def fit_crops(boxes: Floats, size: tuple[int, int], padding: float) -> Floats:
    """Return crops with a net's aspect ratio around boxes (boxes, 3): left, top, px per crop px.

    Args:
        boxes: (boxes, 4) x0, y0, x1, y1 [px].
        size: width, height of a crop [px].
        padding: size of the crop over that of the box, at its tighter side [1].
    """
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2.0
    extent = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0) * padding
    scale = (extent / size).max(axis=1)
    corner = middle - (np.array(size) - 1.0) / 2.0 * scale[:, None]
    return np.hstack([corner, scale[:, None]])


def cut_crops(image: Image, frames: Floats, size: tuple[int, int], fill: int = 0) -> Image:
    """Return the crops (boxes, height, width, 3), smoothed where they are smaller than the frame.

    Args:
        image: the whole frame.
        frames: (boxes, 3) from `fit_crops`.
        size: width, height of a crop [px].
        fill: grey level beyond the frame's border.
    """
    import cv2  # late: it takes a fifth of a second, and planning a run needs none of it

    crops = np.empty((len(frames), size[1], size[0], 3), dtype=np.uint8)
    for crop, (left, top, scale) in zip(crops, frames, strict=True):
        source, shift = image, np.zeros(2)
        halvings = max(0, int(np.floor(np.log2(max(scale, 1.0)))))
        if halvings:
            # A sample every few pixels would miss those between: shrink the neighbourhood first.
            step = 2**halvings
            first = np.maximum(0, np.floor([left, top]).astype(int) - step)
            last = np.ceil([left + scale * size[0], top + scale * size[1]]).astype(int) + step
            part = image[first[1] : max(last[1], first[1]), first[0] : max(last[0], first[0])]
            if not part.size:
                crop[:] = fill
                continue
            target = (-(-part.shape[1] // step), -(-part.shape[0] // step))
            padded = cv2.copyMakeBorder(
                part,
                0,
                target[1] * step - part.shape[0],
                0,
                target[0] * step - part.shape[1],
                cv2.BORDER_REPLICATE,
            )
            source = np.asarray(cv2.resize(padded, target, None, 0, 0, cv2.INTER_AREA), np.uint8)
            shift = first.astype(np.float64)
            left, top = (np.array([left, top]) - shift + 0.5) / step - 0.5
            scale = scale / step
        matrix = np.array([[scale, 0.0, left], [0.0, scale, top]])
        cv2.warpAffine(
            source,
            matrix,
            size,
            crop,
            cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            cv2.BORDER_CONSTANT,
            (fill, fill, fill),
        )
    return crops


def points_in_frame(points: Floats, frames: Floats) -> Floats:
    """Return points of crops in the frame's pixels.

    Args:
        points: (boxes, points, 2) [px of the crop].
        frames: (boxes, 3) from `fit_crops`.
    """
    return np.asarray(points * frames[:, None, 2:] + frames[:, None, :2])


def load_onnx_detector(file: Path, device: str = "cpu") -> Detector:
    """Return a detector of people from an ONNX file.

    The shape of the output decides how it is read: (batch, 4 + classes, anchors) of YOLOv8 and
    later with centre, size and class scores; (batch, anchors, 5 + classes) of YOLOv5 with an
    objectness score before the class scores; (batch, boxes, 6) of exports with built-in
    suppression: corners, score and class; (batch, people, 56) of MoveNet MultiPose. Inputs are
    RGB, as 0..1 for all but MoveNet, which takes 0..255.

    Args:
        file: the net.
        device: `cpu` or `cuda`.

    Raises:
        InputError: onnxruntime is not installed, or the file is no such net.
    """
    net = OnnxNet(file, device, VIEW_SIZE)
    shape = net.outputs[0] if net.outputs else ()
    if len(shape) != 3:
        raise unknown_outputs(net, _FORMS)
    _, rows, columns = shape
    if columns == MULTIPOSE:
        return _OnnxDetector(net, 1.0, lambda found: _read_multipose(found, net.size))
    if columns == 6:
        return _OnnxDetector(net, 1.0 / 255.0, _read_corners)
    if rows is not None and (columns is None or rows < columns) and rows > 4:
        return _OnnxDetector(net, 1.0 / 255.0, lambda found: _read_grid(found.T, with_object=False))
    if columns is not None and columns > 5:
        return _OnnxDetector(net, 1.0 / 255.0, lambda found: _read_grid(found, with_object=True))
    raise unknown_outputs(net, _FORMS)


class _OnnxDetector:
    """A detector of people in views of the net's size."""

    def __init__(self, net: OnnxNet, scale: float, read: Reader) -> None:
        self._net, self._scale, self._read_keypoints = net, scale, read

    @property
    def view_size(self) -> tuple[int, int]:
        """Input size of the net."""
        return self._net.size

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each view."""
        if not images:
            return []
        given: NDArray[Any] = np.stack(images)
        if self._scale != 1.0:
            given = given.astype(np.float32) * np.float32(self._scale)
        return [self._read_keypoints(found.astype(np.float64)) for found in self._net.run(given)[0]]


def _read_multipose(found: Floats, size: tuple[int, int]) -> People:
    """Return people from rows with keypoints first, then boxes y0, x0, y1, x1 in 0..1."""
    width, height = size
    corners = found[:, [52, 51, 54, 53]] * [width, height, width, height] - 0.5
    return _above_min_score(corners, found[:, 55])


def _read_corners(found: Floats) -> People:
    """Return people from rows of corners in pixels, score and class."""
    people = found[found[:, 5].round() == PERSON]
    return _above_min_score(people[:, :4] - 0.5, people[:, 4])


def _read_grid(found: Floats, *, with_object: bool) -> People:
    """Return people from rows of centre, size, perhaps objectness, then a score per class."""
    middle, size = found[:, :2], found[:, 2:4]
    score = found[:, 5 + PERSON] * found[:, 4] if with_object else found[:, 4 + PERSON]
    corners = np.hstack([middle - size / 2.0, middle + size / 2.0]) - 0.5
    return suppress(_above_min_score(corners, score), DOUBLES)


def _above_min_score(boxes: Floats, scores: Floats) -> People:
    """Return those above the least score; callers converted pixel edges to pixel centres."""
    kept = scores >= MIN_SCORE
    return People(boxes[kept], np.minimum(scores[kept], 1.0))


def load_onnx_pose(file: Path, device: str = "cpu") -> PoseEstimator:
    """Return a pose estimator from an ONNX file.

    The shape of the outputs decides how they are read: (batch, 1, 17, 3) of MoveNet, y, x and
    score in 0..1; two outputs (batch, 17, n) of RTMPose, a score for every column and row; (batch,
    17, height, width) heat maps. Crops are RGB, 0..255 for MoveNet, else normalized as ImageNet.

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

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box."""
        if not len(boxes):
            return KeypointDetections.empty()
        frames = fit_crops(boxes, self._net.size, PADDING)
        crops: Image | Singles = cut_crops(image, frames, self._net.size)
        if self._normal:
            crops = (crops.astype(np.float32) - MEAN) / SPREAD
        outputs = [output.astype(np.float64) for output in self._net.run(crops)]
        points, confidence = _read_keypoints(outputs, self._net.size)
        found = confidence > 0.0
        points = np.where(found[..., None], points_in_frame(points, frames), np.nan)
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
