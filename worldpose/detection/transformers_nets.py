"""RT-DETR, RT-DETRv2, D-FINE and ViTPose from a folder that transformers saved, without download.

Weights come from safetensors alone: a pickle could run any code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from data_contracts.arrays import Floats, Image
from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import MIN_SCORE, People
from worldpose.detection.onnx_detectors import find_person_classes, select_named_people
from worldpose.detection.onnx_nets import import_library
from worldpose.errors import InputError


class TransformersDetector:
    """A detector of the DETR family."""

    def __init__(
        self, folder: Path, device: str, half: bool, person_classes: Sequence[int] | None = None
    ) -> None:
        """Load a saved checkpoint: config.json, model.safetensors and preprocessor_config.json.

        Arguments are as of `load_bundled_detector`, and person_classes as of `load_onnx_detector`,
        for a net whose names tell no people. InputError if transformers or a GPU is missing, the
        folder holds no such net, or its classes of people are unknown.
        """
        self._torch, library = (import_library(n, str(folder)) for n in ("torch", "transformers"))
        # Kinds of detectors, by `model_type` of config.json.
        kind = _kind(folder, library, ("rt_detr", "rt_detr_v2", "d_fine", "detr"))
        # The processors without a suffix need torchvision.
        named = library.DetrImageProcessorPil if kind == "detr" else library.RTDetrImageProcessorPil
        self._processor = _load_net(folder, named)
        self._net = net = _load_weights(folder, library.AutoModelForObjectDetection, device, half)
        self._device, self._half = device, half
        # transformers writes LABEL_0, LABEL_1 and so on where a checkpoint has no names.
        names = {k: n for k, n in net.config.id2label.items() if not n.startswith("LABEL_")}
        count = net.config.num_labels
        asked = None if select_named_people(names) else person_classes
        self._people = find_person_classes(str(folder), count, names, asked)
        size = self._processor.size
        # To which the processor scales images.
        self.view_size = (int(size.get("width", 640)), int(size.get("height", 640)))

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each image."""
        people = []
        for image in images:  # one by one: kernels for other batches round differently
            given = _tensors(self._processor([image], return_tensors="pt"), self)
            with self._torch.inference_mode():
                outputs = self._net(**given)
            outputs.logits, outputs.pred_boxes = outputs.logits.float(), outputs.pred_boxes.float()
            (found,) = self._processor.post_process_object_detection(
                outputs, threshold=MIN_SCORE, target_sizes=[image.shape[:2]]
            )
            person = np.isin(found["labels"].cpu().numpy(), self._people)
            boxes = found["boxes"].cpu().numpy().astype(np.float64)[person] - 0.5
            scores = found["scores"].cpu().numpy().astype(np.float64)[person]
            people.append(People(boxes, scores))
        return people


class TransformersPose:
    """A ViTPose estimator."""

    def __init__(self, folder: Path, device: str, half: bool) -> None:
        """Load a saved checkpoint; arguments and errors are those of `TransformersDetector`."""
        self._torch, library = (import_library(n, str(folder)) for n in ("torch", "transformers"))
        # Kinds of pose estimators.
        _kind(folder, library, ("vitpose",))
        self._processor = _load_net(folder, library.VitPoseImageProcessorPil)
        self._net = net = _load_weights(folder, library.VitPoseForPoseEstimation, device, half)
        if net.config.num_labels != 17:
            raise InputError(
                str(folder),
                expected="the 17 keypoints of COCO",
                found=f"{net.config.num_labels} keypoints",
                todo="Name a checkpoint that was trained on COCO keypoints.",
            )
        self._device, self._half = device, half
        experts = getattr(net.config.backbone_config, "num_experts", 1)
        self._expert = 0 if experts > 1 else None  # of ViTPose+, the one for COCO

    def estimate(self, image: Image, boxes: Floats) -> KeypointDetections:
        """Return the pose in each box."""
        if not len(boxes):
            return KeypointDetections.empty()
        each = [self._one(image, box) for box in boxes]
        keypoints = np.stack([points for points, _ in each])
        confidence = np.stack([score for _, score in each])
        found = confidence > 0.0
        return KeypointDetections.from_keypoints(
            np.where(found[..., None], keypoints, np.nan),
            np.where(found, np.minimum(confidence, 1.0), np.nan),
        )

    def _one(self, image: Image, box: Floats) -> tuple[Floats, Floats]:
        x0, y0, x1, y1 = box
        corner = [[[float(x0), float(y0), float(x1 - x0), float(y1 - y0)]]]
        given = _tensors(self._processor([image], boxes=corner, return_tensors="pt"), self)
        if self._expert is not None:
            given["dataset_index"] = self._torch.tensor([self._expert], device=self._device)
        with self._torch.inference_mode():
            outputs = self._net(**given)
        outputs.heatmaps = outputs.heatmaps.float().cpu()
        ((pose,),) = self._processor.post_process_pose_estimation(outputs, boxes=corner)
        points = pose["keypoints"].numpy().astype(np.float64)
        return points, pose["scores"].numpy().astype(np.float64).reshape(-1)


def _kind(folder: Path, library: ModuleType, known: tuple[str, ...]) -> str:
    kind = str(_load_net(folder, library.AutoConfig).model_type)
    if kind not in known:
        raise InputError(
            str(folder),
            expected=f"a checkpoint of kind {', '.join(known)}",
            found=kind,
            todo="Name the folder of such a checkpoint.",
        )
    return kind


def _load_net(folder: Path, named: Any, **further: bool) -> Any:  # noqa: ANN401
    from safetensors import SafetensorError  # late: it comes with the libraries of nets

    try:
        return named.from_pretrained(str(folder), local_files_only=True, **further)
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
        raise InputError(
            str(folder),
            expected="a folder with config.json, preprocessor_config.json and model.safetensors",
            found=str(error).splitlines()[0][:200],
            todo="Save the checkpoint and its processors with save_pretrained.",
        ) from error


def _load_weights(folder: Path, named: Any, device: str, half: bool) -> Any:  # noqa: ANN401
    """Return a net with the weights of a folder, which must have all of them."""
    from worldpose.detection.net_inference import require_gpu  # late: it needs torch

    net, told = _load_net(folder, named, use_safetensors=True, output_loading_info=True)
    # Buffers are computed where they are absent.
    missing = sorted(told["missing_keys"] & {name for name, _ in net.named_parameters()})
    if missing:
        raise InputError(
            str(folder),
            expected=f"the weights of a {type(net).__name__}",
            found=f"none of {len(missing)} parameters, such as {missing[0]}",
            todo="Save the whole net, with its head, with save_pretrained.",
        )
    require_gpu(device)
    net = net.eval().to(device)
    return net.half() if half and device == "cuda" else net


def _tensors(
    given: Mapping[str, Any], owner: TransformersDetector | TransformersPose
) -> dict[str, Any]:
    pixels = given["pixel_values"].to(owner._device)
    return {"pixel_values": pixels.half() if owner._half and owner._device == "cuda" else pixels}
