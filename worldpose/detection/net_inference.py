"""Computation of the bundled nets: in floating point on a CPU or GPU, or in 8-bit integers.

All take images of bytes. Needs torch.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import pad
from torch.nn.utils.fusion import fuse_conv_bn_eval

from worldpose.detection.bundled_nets import Block, normalize
from worldpose.detection.onnx_nets import open_session
from worldpose.errors import InputError

Net = TypeVar("Net", bound=nn.Module)
Asked = TypeVar("Asked")
Seen = TypeVar("Seen")
Result = TypeVar("Result")
Tensors = tuple[Tensor, ...]
Given = NDArray[Any] | Tensor
Decode = Callable[[Tensors], Tensors]
"""Returns what is needed of a net's outputs."""

CROPS: Final = 16
"""Crops per batch on a CPU, and the number to whose multiples batches are filled: equal images give
equal bytes."""
WEIGHTS_DIGEST: Final = "weights_sha256"
"""Key of the metadata of a net in integers: SHA-256 of the weights that it was made from."""


class PlacedNet:
    """A net on a device, `cpu` or `cuda`, in batches that fit into memory.

    It has no state besides its batch, which is halved where a GPU's memory is too small, so threads
    may share it.
    """

    def __init__(
        self,
        net: nn.Module | QuantizedNet,
        device: str,
        half: bool,
        decode: Decode | None = None,
        *,
        fill: int = 1,
    ) -> None:
        """Place a net, in integers on the CPU, or in floating point, which is changed in place.

        On a GPU, and only there, convolutions may compute in `half` precision. `decode` returns
        what the caller needs of the outputs of a batch; None = all. Batches in floating point are
        filled to multiples of `fill`. InputError if torch finds no GPU.
        """
        self.device = "cpu" if isinstance(net, QuantizedNet) else device
        # Crops, or frames of full size, that keep a GPU busy.
        self.batch = fill if self.device == "cpu" else 16 * fill
        self._fill, self._decode = fill, decode
        self._net = net if isinstance(net, QuantizedNet) else place_net(net, device)
        self._kind = torch.float16 if half and device == "cuda" else torch.float32
        if isinstance(self._net, nn.Module):
            for module in self._net.modules():
                if isinstance(module, nn.Conv2d):
                    module.to(self._kind)

    def __call__(self, *given: Given) -> Tensors:
        """Return the outputs, on the device, for images (batch, height, width, 3) of bytes."""
        found, start = list[Tensors](), 0
        while start < len(given[0]):
            part = [each[start : start + self.batch] for each in given]
            try:
                with torch.inference_mode():
                    outputs = self._compute(part)
                    found.append(outputs if self._decode is None else self._decode(outputs))
            except torch.OutOfMemoryError:
                if self.batch == 1:
                    raise
                self.batch = max(1, self.batch // 2)
                torch.cuda.empty_cache()
                warnings.warn(
                    f"the GPU's memory is too small: {self.batch} images per batch from now on",
                    RuntimeWarning,
                    stacklevel=2,
                )
                continue
            start += len(part[0])
        if len(found) == 1:
            return found[0]
        return tuple(torch.cat(each) for each in zip(*found, strict=True))

    def _compute(self, given: Sequence[Given]) -> Tensors:
        if isinstance(self._net, QuantizedNet):
            return self._net(*given)
        count = len(given[0])
        placed = (torch.as_tensor(each, device=self.device) for each in given)
        missing = -count % min(self._fill, self.batch)
        if missing:
            placed = (pad(each, [0, 0] * (each.ndim - 1) + [0, missing]) for each in placed)
        images, *maps = placed
        images = normalize(images)
        outputs: Tensors = self._net(*(each.to(self._kind) for each in (images, *maps)))
        if count == len(images):
            return outputs
        # Parameters of the net, among the outputs, have no row per image.
        return tuple(each[:count] if len(each) == len(images) else each for each in outputs)


def run_together(
    steps: Sequence[Generator[Asked, Seen, Result]],
    compute: Callable[[list[int], list[Asked]], Sequence[Seen]],
) -> list[Result]:
    """Return the results of several frames, whose nets see what all ask for at once.

    One generator per frame yields what the nets shall see, gets what they saw, and returns its
    result. `compute` returns that from the numbers of the frames and what they ask for.
    """
    results: dict[int, Result] = {}
    answers: dict[int, Seen | None] = dict.fromkeys(range(len(steps)))
    while answers:
        asked = dict[int, Asked]()
        for number, answer in answers.items():
            try:
                asked[number] = steps[number].send(answer)  # type: ignore[arg-type]
            except StopIteration as end:
                results[number] = end.value
        answers = dict(zip(asked, compute(list(asked), list(asked.values())), strict=True))
    return [results[number] for number in range(len(steps))]


class QuantizedNet:
    """A net in 8-bit integers, for images of bytes, from float weights of a file of that SHA-256.

    Integers give equal bytes for an image, whatever the other images of the batch are.
    """

    def __init__(self, file: Path) -> None:
        """Open a file of infra/embedded_detector/quantize.py; InputError without onnxruntime."""
        self._session = open_session(file, "cpu")
        self._names = [each.name for each in self._session.get_inputs()]
        self.weights_sha256 = self._session.get_modelmeta().custom_metadata_map[WEIGHTS_DIGEST]

    def __call__(self, *given: Given) -> Tensors:
        """Return the outputs for images (batch, height, width, 3) of bytes, and maps."""
        named = dict(zip(self._names, map(np.asarray, given), strict=True))
        found: list[NDArray[Any]] = self._session.run(None, named)
        return tuple(torch.from_numpy(each) for each in found)


def require_gpu(device: str) -> None:
    """Raise InputError for `cuda` where torch finds no GPU."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "detection.device",
            expected="a GPU, because detection.device is cuda",
            found="none that torch can use",
            todo="Set detection.device=cpu, or install the build of torch for the GPU.",
        )


def place_net(net: Net, device: str) -> Net:
    """Return the net on a device, its batch normalisations folded; InputError without a GPU."""
    require_gpu(device)
    placed = fold_normalisations(net.eval()).to(device)
    placed.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return placed


def fold_normalisations(net: Net) -> Net:
    """Change `net` for inference: its normalisations become part of its convolutions."""
    for module in net.modules():
        if isinstance(module, Block):
            convolution, normalisation = module[0], module[1]
            assert isinstance(convolution, nn.Conv2d)
            assert isinstance(normalisation, nn.BatchNorm2d)
            module[0] = fuse_conv_bn_eval(convolution, normalisation)
            module[1] = nn.Identity()
    return net
