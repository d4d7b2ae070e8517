"""The person detector that ships with the project, small and fast on a CPU.

Its training data are rendered matches and real frames of one stadium (infra/embedded_detector). On
other real footage fine-tuned or larger models may serve better. Needs torch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Generator, Sequence
from itertools import chain, islice, pairwise
from typing import Final

import numpy as np

from data_contracts.arrays import Image
from worldpose.detection.bundled_nets import COARSEST, PeopleNet, decode_boxes
from worldpose.detection.enlargement import (
    STEPS,
    Part,
    choose_reduction,
    find_groups,
    find_small,
    restore_size,
)
from worldpose.detection.interfaces import MIN_SCORE, People
from worldpose.detection.net_inference import PlacedNet, QuantizedNet, Tensors, run_together
from worldpose.detection.sampling import Frame, View, pad, place_frames, resize, resized_shape
from worldpose.detection.suppression import suppress

NMS_IOU: Final = 0.7
"""Boxes with a larger intersection over union are of one person [1]."""
Steps = Generator[Sequence[View], list[People], People]
"""Yields what the net shall see, gets the people there, and returns those of the frame."""


class BundledDetector:
    """A net that detects the centres of people and the sides of their boxes.

    Without a camera, a pass over the reduced frame tells the size of its people: a frame of large
    people is seen reduced. A frame without sure people may be a close-up: it is seen at the size at
    which its surest person is surest. It takes whole frames of any size.
    """

    view_size = None

    def __init__(
        self, net: PeopleNet | QuantizedNet, device: str = "cpu", half: bool = False
    ) -> None:
        self._net = PlacedNet(net, device, half)
        # On a GPU, parts of more different sizes are computed at once [px].
        self._multiple = COARSEST if self._net.device == "cpu" else 4 * COARSEST

    def detect(self, images: Sequence[Image]) -> list[People]:
        """Return the people in each frame."""
        return self._people(images, None)

    def detect_parts(self, images: Sequence[Image], parts: Sequence[Part]) -> list[People]:
        """Return the people in each frame; the caller knows where their size is unusual."""
        return self._people(images, parts)

    def _people(self, images: Sequence[Image], parts: Sequence[Part] | None) -> list[People]:
        frames = place_frames(images, self._net.device)
        steps = [_search(frame, parts) for frame in frames]

        def see(_: list[int], asked: list[Sequence[View]]) -> list[list[People]]:
            views = list(chain.from_iterable(asked))
            most = 16 * self._net.batch  # bounds the memory of their maps
            starts = range(0, len(views), most)
            found = chain.from_iterable(self._detect(views[k : k + most]) for k in starts)
            return [list(islice(found, len(each))) for each in asked]

        return run_together(steps, see)

    def _detect(self, views: Sequence[View]) -> list[People]:
        """Return the detections in views; the same person may be there twice."""
        shapes = [resized_shape(view) for view in views]
        same = defaultdict[tuple[int, ...], list[int]](list)
        for number, shape in enumerate(shapes):
            same[tuple(-(-n // self._multiple) * self._multiple for n in shape)].append(number)
        order, maps = list[int](), list[Tensors]()
        for sides, numbers in same.items():
            for start in range(0, len(numbers), self._net.batch):
                some = numbers[start : start + self._net.batch]
                order += some
                maps.append(self._net(pad([views[number] for number in some], sides)))
        rows = decode_boxes(maps, MIN_SCORE).cpu().numpy()
        ends = np.searchsorted(rows[:, 0], np.arange(len(order) + 1))
        high = np.array(shapes)[order][rows[:, 0].astype(int)][:, [1, 0, 1, 0]] - 0.5
        boxes = np.clip(rows[:, 1:5], -0.5, high)
        real = np.all(boxes[:, 2:] - boxes[:, :2] > 1.0, axis=1)
        found: dict[int, People] = {}
        for number, (first, end) in zip(order, pairwise(ends), strict=True):
            best = first + np.argsort(-rows[first:end, 5], kind="stable")[:300]  # most people
            best = best[real[best]]
            found[number] = People(boxes[best], rows[best, 5])
        return [found[number] for number in range(len(views))]


def _search(frame: Frame, parts: Sequence[Part] | None) -> Steps:
    """Search a frame; without `parts`, at the size that its people need."""
    if parts is not None:
        return (yield from _find_all(frame, parts))
    size = (frame.shape[1], frame.shape[0])
    # Half size shows people of full height in the training and of twice that height.
    (sized,) = yield [(frame, 0.5)]
    zoom = choose_reduction(restore_size(sized, size, 0.5))
    close = yield from _close_up(frame, float(sized.scores.max(initial=0.0)))
    if close < 1.0:
        (people,) = yield [(frame, close)]
        return restore_size(suppress(people, NMS_IOU), size, close)
    if zoom < 1.0:
        people = yield from _find_all(resize((frame, zoom)), None)
        return restore_size(people, size, zoom)
    return (yield from _find_all(frame, None))


def _close_up(frame: Frame, usual: float) -> Generator[Sequence[View], list[People], float]:
    """Return the reduction [1] that shows people who fill a frame as in training; 1 for others."""
    if usual >= 0.6:  # the best score of people of usual size
        return 1.0
    best, chosen = usual + 0.05, 1.0
    zooms = (0.25, 0.125, 0.0884, 0.0625)
    found = yield [(frame, zoom) for zoom in zooms]
    for zoom, people in zip(zooms, found, strict=True):
        score = float(people.scores.max(initial=0.0))
        if score > best:
            best, chosen = score, zoom
    return chosen


def _find_all(frame: Frame, parts: Sequence[Part] | None) -> Steps:
    """Return the people in a frame, with passes over its parts."""
    found, *seen = yield [(frame, 1.0), *(part.crop(frame) for part in parts or ())]
    for part, people in zip(parts or (), seen, strict=True):
        found = part.merge(found, people)
    for step in STEPS if parts is None else ():
        found = yield from _look_at(frame, found, find_small(found, frame.shape, step))
    found = yield from _look_at(frame, found, find_groups(found, frame.shape))
    return suppress(found, NMS_IOU)


def _look_at(frame: Frame, found: People, parts: Sequence[Part]) -> Steps:
    """Return the people of earlier passes and of parts of the frame."""
    if parts:
        seen = yield [part.crop(frame) for part in parts]
        for part, people in zip(parts, seen, strict=True):
            found = part.merge(found, people)
    return found
