"""Computation of the bundled nets: in floating point on a CPU or GPU, or in 8-bit integers.

All take images of bytes and return their outputs on the CPU. Needs torch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from data_contracts.arrays import Image, Singles
from worldpose.detection.bundled_nets import Block, normalize
from worldpose.detection.onnx_nets import open_session
from worldpose.errors import InputError

Net = TypeVar("Net", bound=nn.Module)
Tensors = tuple[Tensor, ...]
Compute = Callable[[Sequence[Tensor]], Tensors]
"""Returns outputs for inputs."""
Decode = Callable[[Tensors], Tensors]
"""Returns what is needed of a net's outputs."""

CROPS: Final = 16
"""Crops per batch."""
WEIGHTS_DIGEST: Final = "weights_sha256"
"""Key of the metadata of a net in integers: SHA-256 of the weights that it was made from."""
_CAPTURING: Final = Lock()


class PlacedNet(Protocol):
    """A net where it is computed."""

    def __call__(self, images: Image, surroundings: Singles | None = None) -> Tensors:
        """Return the outputs on the CPU, the rows of the given images first.

        The next call may overwrite them.
        """


def placed_net(
    net: nn.Module | QuantizedNet,
    device: str,
    half: bool,
    decode: Decode | None = None,
    *,
    batch: int = 1,
) -> PlacedNet:
    """Return a net in integers, which computes on the CPU, or a `FloatNet` of the arguments."""
    if isinstance(net, QuantizedNet):
        return net if decode is None else DecodedNet(net, decode)
    return FloatNet(net, device, half, decode, batch=batch)


class FloatNet:
    """A net in floating point on a device, for images of bytes."""

    def __init__(
        self,
        net: nn.Module,
        device: str = "cpu",
        half: bool = False,
        decode: Decode | None = None,
        *,
        batch: int = 1,
    ) -> None:
        """Place a net.

        Args:
            net: one of the bundled nets, changed in place.
            device: `cpu` or `cuda`.
            half: convolutions compute in half precision, on a GPU only.
            decode: returns what the caller needs of the outputs, on the device; None = all.
            batch: most images of a call.

        Raises:
            InputError: torch finds no GPU.
        """
        self._net, self._decode, self._batch = place_net(net, device), decode, batch
        self._kind = torch.float16 if half and device == "cuda" else torch.float32
        for module in self._net.modules():
            if isinstance(module, nn.Conv2d):
                module.to(self._kind)
        self._on_gpu = None if device == "cpu" else GraphReplay(self.compute, batch)

    def __call__(self, images: Image, surroundings: Singles | None = None) -> Tensors:
        """Return the outputs; see `PlacedNet`."""
        given = [torch.from_numpy(images)]
        if surroundings is not None:
            given.append(torch.from_numpy(surroundings))
        with torch.inference_mode():
            if self._on_gpu is not None:
                return self._on_gpu.run(given)
            return self.compute([_fill(each, self._batch) for each in given])

    def compute(self, inputs: Sequence[Tensor]) -> Tensors:
        """Return the outputs for inputs on the device."""
        images = normalize(inputs[0]).to(self._kind)
        found: Tensors = (
            self._net(images) if len(inputs) == 1 else self._net(images, inputs[1].to(self._kind))
        )
        return found if self._decode is None else self._decode(found)


def _fill(given: Tensor, batch: int) -> Tensor:
    """Return `batch` rows, of which the first are the given ones."""
    missing = batch - len(given)
    return torch.cat([given, given.new_zeros(missing, *given.shape[1:])]) if missing else given


class GraphReplay:
    """Computations on a GPU, launched at once as a CUDA graph for each shape of their inputs.

    One by one, the kernels of a small net take several times as long to launch as to compute.
    """

    def __init__(self, compute: Compute, batch: int) -> None:
        """Wrap a computation."""
        self._compute, self._batch = compute, batch
        self._seen = Counter[tuple[torch.Size, ...]]()
        self._graphs: dict[tuple[torch.Size, ...], _Graph] = {}

    def run(self, inputs: Sequence[Tensor]) -> Tensors:
        """Return outputs on the CPU for inputs there, which the next call overwrites."""
        shapes = tuple(each.shape[1:] for each in inputs)
        self._seen[shapes] += 1
        if shapes not in self._graphs:
            whole = [_fill(each, self._batch) for each in inputs]
            # Crops of groups of people have many shapes, each of them seldom; a graph takes some
            # megabytes of the GPU's memory.
            if self._seen[shapes] < 3 or len(self._graphs) >= 32:
                return tuple(each.cpu() for each in self._compute([each.cuda() for each in whole]))
            self._graphs[shapes] = _Graph.capture(self._compute, whole)
        return self._graphs[shapes].replay(inputs)


class _Graph(NamedTuple):
    """A captured computation.

    Attributes:
        graph: its kernels.
        done: event at its end; waiting for it leaves the processor to others.
        inputs: buffers of the inputs, page-locked and on the GPU.
        outputs: buffers of the outputs, page-locked and on the GPU.
    """

    graph: torch.cuda.CUDAGraph
    done: torch.cuda.Event
    inputs: list[tuple[Tensor, Tensor]]
    outputs: list[tuple[Tensor, Tensor]]

    @classmethod
    def capture(cls, compute: Compute, given: Sequence[Tensor]) -> _Graph:
        """Return the computation for inputs of these shapes."""
        with _CAPTURING:
            inputs = [(each.pin_memory(), each.cuda()) for each in given]
            device = [each for _, each in inputs]
            aside = torch.cuda.Stream()
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                # Libraries choose kernels and allocate on the first calls.
                for _ in range(2):
                    compute(device)
            torch.cuda.current_stream().wait_stream(aside)
            graph = torch.cuda.CUDAGraph()
            # Another unit may use the GPU in another thread.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                found = compute(device)
        outputs = [(torch.empty_like(each, device="cpu", pin_memory=True), each) for each in found]
        done = torch.cuda.Event(blocking=True)
        return cls(graph, done, inputs, outputs)

    def replay(self, given: Sequence[Tensor]) -> Tensors:
        """Return the outputs for some inputs; rows beyond these keep their last values."""
        for each, (host, device) in zip(given, self.inputs, strict=True):
            host[: len(each)].copy_(each)
            device.copy_(host, non_blocking=True)
        self.graph.replay()
        for host, device in self.outputs:
            host.copy_(device, non_blocking=True)
        self.done.record()
        self.done.synchronize()
        return tuple(host for host, _ in self.outputs)


class QuantizedNet:
    """A net in 8-bit integers, for images of bytes.

    Integers give equal bytes for an image, whatever the other images of the batch are.

    Attributes:
        weights_sha256: SHA-256 of the file of float weights that it was made from.
    """

    def __init__(self, file: Path) -> None:
        """Open a file that infra/embedded_detector/quantize.py has written.

        Raises:
            InputError: onnxruntime is not installed.
        """
        self._session = open_session(file, "cpu")
        self._names = [each.name for each in self._session.get_inputs()]
        self.weights_sha256 = self._session.get_modelmeta().custom_metadata_map[WEIGHTS_DIGEST]

    def __call__(self, images: Image, surroundings: Singles | None = None) -> Tensors:
        """Return the outputs for any number of images; see `PlacedNet`."""
        planes = np.ascontiguousarray(images.transpose(0, 3, 1, 2))
        inputs = dict(zip(self._names, (planes, surroundings), strict=False))
        found: list[NDArray[Any]] = self._session.run(None, inputs)
        return tuple(torch.from_numpy(each) for each in found)


class DecodedNet:
    """A net on the CPU with what is needed of its outputs."""

    def __init__(self, net: PlacedNet, decode: Decode) -> None:
        self._net, self._decode = net, decode

    def __call__(self, images: Image, surroundings: Singles | None = None) -> Tensors:
        """Return the decoded outputs; see `PlacedNet`."""
        with torch.inference_mode():
            return self._decode(self._net(images, surroundings))


def place_net(net: Net, device: str) -> Net:
    """Return the net on a device, its batch normalisations folded into convolutions.

    Raises:
        InputError: torch finds no GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "detection.device",
            expected="a GPU, because detection.device is cuda",
            found="none that torch can use",
            todo="Set detection.device=cpu, or install the build of torch for the GPU.",
        )
    placed = fold_normalisations(net.eval()).to(device)
    placed.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return placed


def fold_normalisations(net: Net) -> Net:
    """Return `net` for inference: its normalisations are part of its convolutions.

    Args:
        net: net with its weights, changed in place.
    """
    for module in net.modules():
        if isinstance(module, Block):
            convolution, normalisation = module[0], module[1]
            assert isinstance(convolution, nn.Conv2d)
            assert isinstance(normalisation, nn.BatchNorm2d)
            module[0] = fuse_conv_bn_eval(convolution, normalisation)
            module[1] = nn.Identity()
    return net
