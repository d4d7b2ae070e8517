"""Nets in ONNX files, run by onnxruntime on one thread: equal images give equal bytes."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError


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
        runtime = _runtime(self.where)
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
                todo="Export it again.",
            ) from error
        inputs = self._session.get_inputs()
        shape = [side if isinstance(side, int) else None for side in inputs[0].shape]
        if len(inputs) != 1 or len(shape) != 4 or 3 not in (shape[1], shape[3]):
            raise InputError(
                self.where,
                expected="one input, a batch of pictures with 3 channels",
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

    def run(self, pictures: NDArray[Any]) -> list[NDArray[Any]]:
        """Return all outputs for images (batch, height, width, 3), in the range that the net takes.

        The result of an image must not depend on its neighbours: each runs alone.
        """
        each = []
        for picture in pictures:
            given = picture if self.channels_last else np.moveaxis(picture, -1, 0)
            batch = np.ascontiguousarray(given[None].astype(self.dtype))
            each.append(self._session.run(None, {self._name: batch}))
        return [np.concatenate(parts) for parts in zip(*each, strict=True)]


def unknown_outputs(net: OnnxNet, expected: str) -> InputError:
    """Return the error for a net with unknown outputs."""
    return InputError(
        net.where,
        expected=expected,
        found=f"outputs of shapes {_listed(net.outputs)}",
        todo="Export it in one of these forms.",
    )


_DTYPES = {
    "tensor(int32)": np.dtype(np.int32),
    "tensor(uint8)": np.dtype(np.uint8),
    "tensor(float16)": np.dtype(np.float16),
    "tensor(float)": np.dtype(np.float32),
}


def _listed(shapes: Sequence[tuple[int | None, ...]]) -> str:
    return ", ".join(str(shape) for shape in shapes)


def _runtime(where: str) -> ModuleType:
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
