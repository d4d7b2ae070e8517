"""Person detectors in ONNX files: the form of a net's output decides its input and decoding."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Floats, Image, Singles
from worldpose.detection.interfaces import MIN_SCORE, Detector, People
from worldpose.detection.onnx_nets import IMAGENET_MEAN, IMAGENET_STD, OnnxNet
from worldpose.detection.suppression import suppress
from worldpose.errors import InputError
from worldpose.parsing import parse_in_turn

STRIDES: Final = ((8, 16, 32), (8, 16, 32, 64))
"""Strides of the grids of YOLO nets, without and with a fourth level [px]."""
PERSON_NAMES: Final = frozenset(
    {"goalkeeper", "keeper", "player", "players", "referee"}
    | {"human", "pedestrian", "people", "person"}
)
"""Names of classes of people."""
Outputs = Sequence[NDArray[Any]]
Decoder = Callable[[Outputs, tuple[int, int], Sequence[int]], People]


@dataclass(frozen=True)
class Form:
    """Input and output of a family of nets.

    Attributes:
        outputs: description for messages.
        decode: the people of one view, from the outputs without their batch dimension, the size of
            the view (width, height) [px], and the classes of people.
        classes: the number of classes, from the outputs; None if the form has class labels.
        scale: scale of grey levels 0..255, before mean and std.
        mean, std: per channel, subtracted and divided by, after scaling.
        bgr: channels are blue, green, red.
    """

    outputs: str
    decode: Decoder
    classes: Callable[[Outputs], int] | None = None
    scale: float = 1.0 / 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    bgr: bool = False

    def prepare(self, images: NDArray[Any]) -> Singles:
        """Return images (n, height, width, 3) of RGB 0..255 as the net takes them."""
        ordered = images[..., ::-1] if self.bgr else images
        given: Singles = ordered.astype(np.float32) * np.float32(self.scale)
        return np.divide(given - np.array(self.mean, np.float32), np.array(self.std, np.float32))


def load_onnx_detector(
    file: Path,
    device: str = "cpu",
    form: str | None = None,
    person_classes: Sequence[int] | None = None,
) -> Detector:
    """Return a detector of people from an ONNX file, on `cpu` or `cuda`.

    The form is a name in `FORMS`; None: recognized from the outputs for a grey image. Classes of
    people are by default the net's own names, or COCO's person. InputError if onnxruntime is not
    installed, the file is no such net, its form is in doubt, or its classes of people are unknown.
    """
    if form is not None and form not in FORMS:
        raise InputError(
            f"detection.detector: onnx-{form}",
            expected=f"one of {_choices(FORMS)}",
            found=repr(form),
            todo="Name the form of the net, or write onnx:FILE to let worldpose recognize it.",
        )
    # Input size for a net that takes any size [px].
    net = OnnxNet(file, device, (640, 640))
    outputs = _probe(net)
    chosen = FORMS[form or recognize_form(net.where, outputs, net.size)]
    names = _class_names(net.metadata)
    count = None if chosen.classes is None else chosen.classes(outputs)
    return _OnnxDetector(net, chosen, find_person_classes(net.where, count, names, person_classes))


def recognize_form(where: str, outputs: Outputs, size: tuple[int, int]) -> str:
    """Return the one form of a net's outputs for one image, without the batch dimension.

    `size` is width, height of the net's input [px]. InputError, with the file `where`, for none, or
    more than one.
    """
    shapes = [output.shape for output in outputs]
    fitting: tuple[str, ...] = ()
    if [len(shape) for shape in shapes] == [2]:
        fitting = _forms_of_single_output(outputs[0], size)
    elif [len(shape) for shape in shapes] == [2, 1] and shapes[0][1] == 5:
        fitting = ("rtmdet", "yolox-dets")
    elif len(shapes) == 3 and sorted(map(len, shapes)) == [1, 1, 2]:
        fitting = ("rtdetr-boxes",)
    elif [len(shape) for shape in shapes] == [2, 2] and 4 in (shapes[0][1], shapes[1][1]):
        classes = _detr_logits(outputs).shape[1]
        known = {92: ("detr",), 91: ("rfdetr",), 80: ("rtdetr",)}
        fitting = known.get(classes, ("detr", "rfdetr", "rtdetr"))
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(str(shape) for shape in shapes)
    if fitting:
        raise InputError(
            where,
            expected="outputs of one known form",
            found=f"outputs of shapes {listed}, which several families of nets have",
            todo="Name the form, for example detection.detector=onnx-"
            f"{fitting[0]}:FILE. Possible: {_choices(fitting)}.",
        )
    raise InputError(
        where,
        expected="outputs of a known form",
        found=f"outputs of shapes {listed} for an image of {size[0]} x {size[1]} px",
        todo=f"Export the net in one of these forms: {_choices(FORMS)}.",
    )


def _forms_of_single_output(output: NDArray[Any], size: tuple[int, int]) -> tuple[str, ...]:
    rows, columns = output.shape
    cells = {_cell_count(size, strides) for strides in STRIDES}
    if columns > 5 and rows in {3 * count for count in cells}:
        return ("yolov5",)
    if columns > 5 and rows in cells and columns != 84:  # else 80 classes without objectness
        if (output[:, 4] == 1.0).all():
            return ("yolov6",)
        return ("yolox" if _are_raw(output, size) else "yolox-decoded",)
    if rows > 4 and columns in cells:
        return ("yolov8",)
    if columns == 56 and rows <= 100:
        return ("movenet",)
    return ("yolo-nms",) if columns in (6, 57) else ()


def _are_raw(output: NDArray[Any], size: tuple[int, int]) -> bool:
    """Return whether centres are offsets in cells, not pixels: the closer reading to the grid."""
    centers, strides = _grid(size, len(output))
    as_pixels = np.abs(output[:, :2] / strides[:, None] - centers)
    return bool(np.median(np.abs(output[:, :2])) < np.median(as_pixels))


def _probe(net: OnnxNet) -> list[NDArray[Any]]:
    """Return the outputs for a grey image, without the batch dimension."""
    width, height = net.size
    grey = np.full((1, height, width, 3), 114, dtype=np.uint8)
    return [output[0] for output in _flat_outputs(net.run(grey))]


def _flat_outputs(outputs: Outputs) -> list[NDArray[Any]]:
    """Return the outputs that list boxes; others are grids of earlier layers or masks."""
    return [output for output in outputs if 2 <= output.ndim <= 3]


def _cell_count(size: tuple[int, int], strides: Iterable[int]) -> int:
    return sum((size[0] // stride) * (size[1] // stride) for stride in strides)


def _grid(size: tuple[int, int], count: int) -> tuple[Floats, Floats]:
    """Return the column and row of every cell (cells, 2), and its stride [px]."""
    strides = next(each for each in STRIDES if _cell_count(size, each) == count)
    cells, widths = [], []
    for stride in strides:
        rows, columns = np.mgrid[: size[1] // stride, : size[0] // stride]
        cells.append(np.stack([columns, rows], axis=-1).reshape(-1, 2))
        widths.append(np.full(rows.size, float(stride)))
    return np.concatenate(cells).astype(np.float64), np.concatenate(widths)


def _class_names(metadata: Mapping[str, str]) -> dict[int, str]:
    """Return the class names that an exporter wrote into the file; {} if there are none."""
    try:
        names = parse_in_turn(lambda: ast.literal_eval(metadata.get("names", "{}")))
        if isinstance(names, list | tuple):
            names = dict(enumerate(names))
        pairs = list(names.items()) if isinstance(names, dict) else []
        if all(isinstance(name, int) for _, name in pairs):  # numbers by name
            pairs = [(number, name) for name, number in pairs]
        return {int(number): str(name) for number, name in pairs}
    except (SyntaxError, ValueError, TypeError):
        return {}


def select_named_people(names: Mapping[int, str]) -> tuple[int, ...]:
    """Return the classes whose names are those of people."""
    return tuple(k for k, name in names.items() if name.lower() in PERSON_NAMES)


def find_person_classes(
    where: str, count: int | None, names: Mapping[int, str], asked: Sequence[int] | None
) -> tuple[int, ...]:
    """Return the classes of people of a net, of which `count`, if known, have `names` or {}.

    `where` is its file, for messages, and `asked` is `detection.person_classes`.
    """
    if asked is not None:
        if count is not None and any(number >= count for number in asked):
            raise InputError(
                where,
                expected=f"classes below {count} in detection.person_classes",
                found=", ".join(map(str, asked)),
                todo="Correct detection.person_classes.",
            )
        return tuple(asked)
    if people := select_named_people(names):
        return people
    if (count or len(names)) == 1:  # whatever its name
        return (0,) if count else tuple(names)
    # Class of people by number of classes: COCO's 80, its 91 numbered ones, and these with a last
    # class for no object.
    coco_person = {80: 0, 91: 1, 92: 1}
    if names or (count is not None and count > 1 and count not in coco_person):
        raise InputError(
            where,
            expected="a class of people: " + ", ".join(sorted(PERSON_NAMES)),
            found=", ".join(f"{k} {name}" for k, name in names.items())
            or f"{count} classes without names",
            todo="Set detection.person_classes to the numbers of these classes, "
            "for example detection.person_classes=[0].",
        )
    return (coco_person.get(count or 0, 0),)


class _OnnxDetector:
    """A detector of people in views of the net's size."""

    def __init__(self, net: OnnxNet, form: Form, people: tuple[int, ...]) -> None:
        self._net, self._form, self._people = net, form, people
        self.view_size = net.size

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each view."""
        if not images:
            return []
        given: NDArray[Any] = np.stack(images)
        if not np.issubdtype(self._net.dtype, np.integer):  # else the net itself converts
            given = self._form.prepare(given)
        outputs = [output.astype(np.float64) for output in _flat_outputs(self._net.run(given))]
        return [
            self._form.decode([output[k] for output in outputs], self._net.size, self._people)
            for k in range(len(images))
        ]


def _above_min_score(boxes: Floats, scores: Floats) -> People:
    """Return the people with a score of at least `MIN_SCORE`, boxes shifted to pixel centres."""
    kept = (scores >= MIN_SCORE) & np.isfinite(boxes).all(axis=1)
    return People(boxes[kept] - 0.5, np.minimum(scores[kept], 1.0))


def _corners(centers_and_sizes: Floats) -> Floats:
    middle, half = centers_and_sizes[:, :2], centers_and_sizes[:, 2:4] / 2.0
    return np.hstack([middle - half, middle + half])


def _best(scores: Floats, people: Sequence[int]) -> Floats:
    """Return the best score among classes of people (rows,)."""
    return np.asarray(scores[:, list(people)].max(axis=1))


def _select_labelled(
    boxes: Floats, scores: Floats, labels: Floats, people: Sequence[int]
) -> People:
    shown = np.isin(labels.round(), people)
    return _above_min_score(boxes[shown], scores[shown])


def decode_grid(found: Floats, people: Sequence[int], *, with_object: bool) -> People:
    """Return people from rows of centre, size [px], perhaps objectness, then a score per class."""
    scores = found[:, 4:]
    score = scores[:, 0] * _best(scores[:, 1:], people) if with_object else _best(scores, people)
    kept = score >= MIN_SCORE  # most cells are empty
    # Boxes of a raw grid with a larger intersection over union are of one person [1].
    return suppress(_above_min_score(_corners(found[kept]), score[kept]), 0.7)


def _decode_yolox(outputs: Outputs, size: tuple[int, int], people: Sequence[int]) -> People:
    found = outputs[0].copy()
    cells, strides = _grid(size, len(found))
    found[:, :2] = (found[:, :2] + cells) * strides[:, None]
    found[:, 2:4] = np.exp(np.minimum(found[:, 2:4], 20.0)) * strides[:, None]
    return decode_grid(found, people, with_object=True)


def _decode_boxes(outputs: Outputs, _: tuple[int, int], people: Sequence[int]) -> People:
    boxes = next(output for output in outputs if output.ndim == 2)
    flat = [output for output in outputs if output.ndim == 1]
    whole = [bool((output == output.round()).all()) for output in flat]
    labels, scores = flat if whole[0] and not whole[1] else flat[::-1]
    return _select_labelled(boxes, scores, labels, people)


def _decode_movenet(outputs: Outputs, size: tuple[int, int], _: Sequence[int]) -> People:
    """Return people from rows with keypoints first, then y0, x0, y1, x1 in 0..1, and a score."""
    found = outputs[0]
    return _above_min_score(found[:, [52, 51, 54, 53]] * [*size, *size], found[:, 55])


def _detr_boxes(outputs: Outputs) -> NDArray[Any]:
    return outputs[0] if outputs[0].shape[1] == 4 else outputs[1]


def _detr_logits(outputs: Outputs) -> NDArray[Any]:
    return outputs[1] if outputs[0].shape[1] == 4 else outputs[0]


def _decode_sigmoid(outputs: Outputs, size: tuple[int, int], people: Sequence[int]) -> People:
    score = _best(1.0 / (1.0 + np.exp(-_detr_logits(outputs))), people)
    return _above_min_score(_corners(_detr_boxes(outputs)) * [*size, *size], score)


def _decode_softmax(outputs: Outputs, size: tuple[int, int], people: Sequence[int]) -> People:
    logits = _detr_logits(outputs)
    share = np.exp(logits - logits.max(axis=1, keepdims=True))
    share = share[:, :-1] / share.sum(axis=1, keepdims=True)
    return _above_min_score(_corners(_detr_boxes(outputs)) * [*size, *size], _best(share, people))


def _decode_with_object(outputs: Outputs, _: tuple[int, int], people: Sequence[int]) -> People:
    return decode_grid(outputs[0], people, with_object=True)


def _decode_labelled(outputs: Outputs, _: tuple[int, int], people: Sequence[int]) -> People:
    """Return people from rows of corners and score, then a label there or in another output."""
    found = outputs[0]
    labels = found[:, 5] if found.shape[1] > 5 else outputs[1]
    return _select_labelled(found[:, :4], found[:, 4], labels, people)


def _count_with_object(outputs: Outputs) -> int:
    return int(outputs[0].shape[1] - 5)


def _count_columns(outputs: Outputs) -> int:
    # Of pose nets, 4 + 1 + 51 rows, the first class alone is one.
    rows = int(outputs[0].shape[0])
    return 1 if rows == 56 else rows - 4


def _count_logits(outputs: Outputs) -> int:
    return int(_detr_logits(outputs).shape[1])


_BGR: Final[dict[str, Any]] = {"scale": 1.0, "bgr": True}
_IMAGENET: Final[dict[str, Any]] = {
    "scale": 1.0,
    "mean": tuple(IMAGENET_MEAN.tolist()),
    "std": tuple(IMAGENET_STD.tolist()),
}
FORMS: Final[Mapping[str, Form]] = {
    "yolox": Form(
        "(cells, 5 + classes), offsets in cells; takes BGR 0..255",
        *(_decode_yolox, _count_with_object),
        **_BGR,
    ),
    "yolox-decoded": Form(
        "(cells, 5 + classes), pixels; takes BGR 0..255",
        *(_decode_with_object, _count_with_object),
        **_BGR,
    ),
    "yolox-dets": Form(
        "(boxes, 5) and labels, of mmdeploy; takes BGR 0..255", _decode_labelled, **_BGR
    ),
    "yolov5": Form(
        "(3 cells, 5 + classes); also YOLOv7; takes RGB 0..1",
        *(_decode_with_object, _count_with_object),
    ),
    "yolov6": Form(
        "(cells, 5 + classes), objectness 1; takes RGB 0..1",
        *(_decode_with_object, _count_with_object),
    ),
    "yolov8": Form(
        "(4 + classes, cells); also later ones; takes RGB 0..1",
        lambda outputs, _, people: decode_grid(outputs[0].T, people, with_object=False),
        _count_columns,
    ),
    "yolo-nms": Form("(boxes, 6): corners, score, label; takes RGB 0..1", _decode_labelled),
    "detr": Form(
        "logits (queries, classes + 1) and boxes 0..1; takes RGB normalized as ImageNet",
        *(_decode_softmax, _count_logits),
        **_IMAGENET,
    ),
    "rfdetr": Form(
        "logits (queries, classes) and boxes 0..1; also Deformable DETR; takes RGB normalized as "
        "ImageNet",
        *(_decode_sigmoid, _count_logits),
        **_IMAGENET,
    ),
    "rtdetr": Form(
        "logits (queries, classes) and boxes 0..1; also D-FINE; takes RGB 0..1",
        *(_decode_sigmoid, _count_logits),
    ),
    "rtdetr-boxes": Form(
        "labels, boxes [px] and scores, with a second input for the image size; takes RGB 0..1",
        _decode_boxes,
    ),
    "rtmdet": Form(
        "(boxes, 5) and labels, of mmdeploy; takes BGR normalized as ImageNet",
        _decode_labelled,
        mean=(103.53, 116.28, 123.675),
        std=(57.375, 57.12, 58.395),
        **_BGR,
    ),
    "movenet": Form(
        "(people, 56) of MoveNet MultiPose; takes RGB 0..255",
        *(_decode_movenet, lambda _: 1),
        scale=1.0,
    ),
}
"""By the name that follows `onnx-` in detection.detector."""


def _choices(names: Iterable[str]) -> str:
    return "; ".join(f"{name}: {FORMS[name].outputs}" for name in names)
