"""Writes the bundled nets in 8-bit integers, which CPUs without a GPU compute three times as fast.

    pip install onnx
    python infra/embedded_detector/quantize.py DATA FOLDER [--only people keypoints landmarks]

Reads the shipped float weights, and writes `embedded_people.onnx`, `embedded_keypoints.onnx` and
`embedded_landmarks.onnx` beside them. The ranges of activations come from what the production code
feeds the nets: rendered scenes of the training kind in FOLDER, the first half of the panorama's
match and the first hundred frames of the static pair (see real_frames.py). Last layers stay in
single precision, since positions are sums over their maps. Weights have seven bits: processors
without VNNI add pairs of products in 16 bits, which overflow with eight.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.shape_inference import quant_pre_process
from real_frames import read_frames, read_panorama
from scenes import TRAINING, read_set, render_set
from torch import Tensor, nn

from data_contracts.arrays import Image
from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.bundled_nets import (
    COARSEST,
    GREY_MEAN,
    GREY_SPREAD,
    KeypointNet,
    PeopleNet,
    load_weights,
)
from worldpose.detection.bundled_pose import BundledPoseEstimator
from worldpose.detection.landmark_net import LandmarkNet, SeenLandmarks
from worldpose.detection.models import BUNDLED_WEIGHTS, LANDMARK_WEIGHTS
from worldpose.detection.net_inference import WEIGHTS_DIGEST, place_net
from worldpose.detection.settings import DetectionSettings
from worldpose.ingest.registration import digest_of_files
from worldpose.training.labels import read_picture

SCENES: Final = 4
"""Rendered scenes, of four images each."""
STILLS: Final = 8
"""Images of the panorama, and frames of each video of the pair."""
INPUTS: Final = 40
"""Inputs of each net that tell the ranges of activations; a random choice of all."""
WINDOW: Final = 640
"""Longest side of these inputs [px]; larger frames are cut at random, since all activations of an
input are in memory at once."""


class Recorder:
    """Keeps a random choice of the inputs of a net, as a hook of its module."""

    def __init__(self) -> None:
        self._draw, self._count = random.Random(0), 0
        self.inputs: list[tuple[NDArray[Any], ...]] = []

    def __call__(self, _net: nn.Module, given: tuple[Tensor, ...]) -> None:
        """Keep the inputs or not."""
        self._count += 1
        # Every input is kept with the same probability.
        place = self._count - 1 if self._count <= INPUTS else self._draw.randrange(self._count)
        if place < INPUTS:
            self.inputs[place : place + 1] = [self._cut(*given)]

    def _cut(self, images: Tensor, *maps: Tensor) -> tuple[NDArray[Any], ...]:
        """Return the inputs; of larger images a window, whole cells of the coarsest map."""
        top, left = (
            COARSEST * self._draw.randint(0, max(0, side - WINDOW) // COARSEST)
            for side in images.shape[2:]
        )
        window = images[:, :, top : top + WINDOW, left : left + WINDOW]
        return tuple(np.ascontiguousarray(each.numpy()) for each in (window, *maps))


class InputReader(CalibrationDataReader):  # type: ignore[misc]
    """Inputs of a net, one after another, as onnxruntime takes them."""

    def __init__(self, inputs: Sequence[tuple[NDArray[Any], ...]], names: Sequence[str]) -> None:
        self._inputs = iter(dict(zip(names, each, strict=True)) for each in inputs)

    def get_next(self) -> dict[str, NDArray[Any]] | None:
        """Return the next inputs; None at the end."""
        return next(self._inputs, None)


def calibration_images(data: Path, folder: Path) -> Iterator[Image]:
    """Yield rendered and real frames, none of them of a set that measures nets."""
    for line in render_set(folder, TRAINING, SCENES, frames=1):
        print(line, flush=True)
    stills = read_panorama(data)
    stills = [stills[i] for i in np.linspace(0, len(stills) - 1, STILLS).round().astype(int)]
    for picture in (*read_set(folder), *stills):
        yield read_picture(picture.path)
    for side in ("left", "right"):
        for _, image in read_frames(data / "static_pair" / f"{side}_camera.mp4"):
            yield image


def collect_inputs(
    images: Iterator[Image], people: PeopleNet, keypoints: KeypointNet
) -> tuple[list[tuple[NDArray[Any], ...]], list[tuple[NDArray[Any], ...]]]:
    """Return what both nets are given for images: normalized frames and crops, and maps."""
    detector, pose = BundledDetector(people), BundledPoseEstimator(keypoints)
    recorders = Recorder(), Recorder()
    hooks = [
        net.register_forward_pre_hook(recorder)
        for net, recorder in zip((people, keypoints), recorders, strict=True)
    ]
    least = DetectionSettings().low_score_threshold
    for image in images:
        (found,) = detector.detect([image])
        pose.estimate(image, found.boxes[found.scores >= least])
    for hook in hooks:
        hook.remove()
    return recorders[0].inputs, recorders[1].inputs


def quantize(
    net: nn.Module,
    inputs: Sequence[tuple[NDArray[Any], ...]],
    outputs: Sequence[str],
    kept: Sequence[str],
    weights: Path,
) -> None:
    """Write a net in integers, which takes images of bytes (batch, height, width, 3).

    Args:
        net: placed, so that its normalisations are folded.
        inputs: its inputs in floating point.
        outputs: names of its outputs.
        kept: prefixes of the names of modules that stay in floating point.
        weights: its file; the written one has the same name with the ending `.onnx`, and its
            digest.
    """
    file = weights.with_suffix(".onnx")
    names = ["images", "around"][: len(inputs[0])]
    plain, ready, small = (file.with_suffix(f".{part}.onnx") for part in ("float", "ready", "8"))
    sides = {0: "batch", 2: "height", 3: "width"}
    torch.onnx.export(
        net,
        tuple(torch.from_numpy(each) for each in inputs[0]),
        plain,
        input_names=names,
        output_names=list(outputs),
        dynamic_axes={name: sides if len(inputs[0]) == 1 else {0: "batch"} for name in names},
        dynamo=False,
        opset_version=17,
    )
    quant_pre_process(plain, ready, skip_symbolic_shape=True)
    nodes = onnx.load(ready).graph.node
    floats = [node.name for node in nodes if node.name.startswith(tuple(kept))]
    quantize_static(
        ready,
        small,
        InputReader(inputs, names),
        quant_format=QuantFormat.QDQ,
        op_types_to_quantize=["Conv", "Add", "Resize"],
        per_channel=True,
        reduce_range=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
        nodes_to_exclude=floats,
        calibrate_method=CalibrationMethod.MinMax,
    )
    model = onnx.load(small)
    take_bytes(model)
    helper.set_model_props(model, {WEIGHTS_DIGEST: digest_of_files(weights)})
    onnx.checker.check_model(model)
    draft = file.with_suffix(".part")
    draft.write_bytes(model.SerializeToString(deterministic=True))
    draft.replace(file)
    for each in (plain, ready, small):
        each.unlink()


def take_bytes(model: onnx.ModelProto) -> None:
    """Change the first input to bytes (batch, height, width, 3): they are its integers as they are.

    The scale of normalized images is that of grey levels, and their zero the mean grey level. The
    runtime computes with channels last, so that the transposition costs nothing.
    """
    graph = model.graph
    (first,) = (n for n in graph.node if n.op_type == "QuantizeLinear" and n.input[0] == "images")
    numbers = {
        first.input[1]: np.array(1.0 / GREY_SPREAD, dtype=np.float32),
        first.input[2]: np.array(GREY_MEAN, dtype=np.uint8),
    }
    for initializer in graph.initializer:
        if initializer.name in numbers:
            value = numpy_helper.from_array(numbers[initializer.name], initializer.name)
            initializer.CopyFrom(value)
    for node in graph.node:
        for index, name in enumerate(node.input):
            if name == first.output[0]:
                node.input[index] = "planes"
    graph.node.remove(first)
    graph.node.insert(0, helper.make_node("Transpose", ["images"], ["planes"], perm=[0, 3, 1, 2]))
    (given,) = (each for each in graph.input if each.name == "images")
    given.type.tensor_type.elem_type = TensorProto.UINT8
    sides = list(given.type.tensor_type.shape.dim)
    del given.type.tensor_type.shape.dim[:]
    given.type.tensor_type.shape.dim.extend(sides[k] for k in (0, 2, 3, 1))


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("folder", type=Path)
    nets = ("people", "keypoints", "landmarks")
    parser.add_argument("--only", nargs="+", choices=nets, default=nets)
    options = parser.parse_args()
    people = load_weights(BUNDLED_WEIGHTS[0], PeopleNet())
    keypoints = load_weights(BUNDLED_WEIGHTS[1], KeypointNet())
    images = calibration_images(options.data, options.folder)
    frames, crops = collect_inputs(images, people, keypoints)
    print(f"{len(frames)} frames, {len(crops)} batches of crops")
    # The net of landmarks takes the crops of joints.
    landmarks = place_net(load_weights(LANDMARK_WEIGHTS, LandmarkNet()), "cpu")
    head, around = "/head/head.1", "/around"
    seen = ("maps", "doubt", "boxes", "fit", "trust")
    for net, inputs, outputs, kept, weights in (
        (people, frames, ("logits", "sides"), (head,), BUNDLED_WEIGHTS[0]),
        (keypoints, crops, seen, (head, "/outline/outline.1", around), BUNDLED_WEIGHTS[1]),
        (landmarks, crops, SeenLandmarks._fields, (head, around), LANDMARK_WEIGHTS),
    ):
        if weights.stem.removeprefix("embedded_") in options.only:
            quantize(net, inputs, outputs, kept, weights)
            file = weights.with_suffix(".onnx")
            print(f"{file.name}: {file.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
