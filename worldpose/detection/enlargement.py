"""Frames that a detector sees reduced, and parts of frames that it sees enlarged.

A detector finds people best at the heights of its training. Where a calibrated camera shows people
smaller, or the first pass over a frame finds small people, further passes over enlarged tiles
replace it for them. Where it shows people larger, passes over the reduced frame do; without
calibration, a frame of large people is seen reduced instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

import numpy as np

from data_contracts.arrays import Flags, Floats, Image
from worldpose.detection.interfaces import Detector, People
from worldpose.detection.suppression import suppress
from worldpose.geometry.boxes import box_iou
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate

if TYPE_CHECKING:
    from worldpose.detection.sampling import Frame, View

STEPS: Final = ((36.0, 2.0), (18.0, 3.0))
"""Heights below which people are seen enlarged [px], and the enlargement [1]."""
REDUCTIONS: Final = ((200.0, 0.25), (100.0, 0.5))
"""Heights above which a frame is seen reduced [px], and the reduction [1]: of people of 100 to
270 px in real stills, full size finds 57 %, half or a quarter 95 %."""
BLEND: Final = 1.25
"""Factor by which heights of both passes overlap [1]: no person at the limit is lost."""
MIN_GROUP_SCORE: Final = 0.25
"""Boxes from this score on form a group, and tell the size of a frame's people [1]."""
SAME_PERSON_IOU: Final = 0.6
"""Boxes that overlap more are one person's [1, intersection over union]."""


@dataclass(frozen=True)
class Part:
    """A part of a frame that is seen at another size.

    Attributes:
        corner: left, upper pixel of the crop.
        end: right, lower pixel, not included.
        zoom: enlargement [1]; less than 1 is a reduction.
        inner: x0, y0, x1, y1 of the region that holds the centres of its people [px].
        heights: heights of people that count in it, bounds not included [px].
        replaced: heights between which earlier people with centres in `inner` are dropped [px].
    """

    corner: tuple[int, int]
    end: tuple[int, int]
    zoom: float
    inner: Floats
    heights: tuple[float, float]
    replaced: tuple[float, float] = (0.0, 0.0)

    def crop(self, image: Frame) -> View:
        """Return the part of the frame, and its enlargement."""
        (left, top), (right, bottom) = self.corner, self.end
        return image[top:bottom, left:right], self.zoom

    def to_frame(self, people: People) -> People:
        """Return the part's people among those found in `crop`, in the frame's pixels."""
        (left, top), (right, bottom) = self.corner, self.end
        boxes = restore_size(people, (right - left, bottom - top), self.zoom).boxes
        boxes = boxes + np.array([left, top, left, top])
        tall = boxes[:, 3] - boxes[:, 1]
        mine = self._holds(boxes) & (tall > self.heights[0]) & (tall < self.heights[1])
        return People(boxes, people.scores).select(mine)

    def merge(self, earlier: People, seen: People) -> People:
        """Return earlier people of the frame and those found in `crop`, without those replaced."""
        low, high = self.replaced
        if low < high:
            tall = earlier.boxes[:, 3] - earlier.boxes[:, 1]
            earlier = earlier.select(~self._holds(earlier.boxes) | (tall < low) | (tall >= high))
        return People.concatenate([earlier, self.to_frame(seen)])

    def _holds(self, boxes: Floats) -> Flags:
        """Return whether the centres of boxes lie in `inner` (people,)."""
        x, y = 0.5 * (boxes[:, 0] + boxes[:, 2]), 0.5 * (boxes[:, 1] + boxes[:, 3])
        left, top, right, bottom = self.inner.tolist()
        return np.asarray((x >= left) & (x < right) & (y >= top) & (y < bottom))


@runtime_checkable
class SeesParts(Detector, Protocol):
    """A detector that looks at parts of frames at another size, where people need it."""

    def detect_parts(self, images: Sequence[Image], parts: Sequence[Part]) -> list[People]:
        """Return the people in each image, as `detect`."""


def restore_size(people: People, size: tuple[int, int], zoom: float) -> People:
    """Return people of an image resized by `zoom` in pixels of the original width, height [px]."""
    scale = [side / max(1, round(zoom * side)) for side in (*size, *size)]
    return People((people.boxes + 0.5) * scale - 0.5, people.scores)


def choose_reduction(people: People) -> float:
    """Return the factor by which a frame of these people is best reduced; 1 = not at all [1]."""
    tall = _sure_heights(people)
    middle = float(np.median(tall)) if len(tall) else 0.0
    return next((zoom for limit, zoom in REDUCTIONS if middle > limit), 1.0)


def _sure_heights(people: People) -> Floats:
    """Return the heights of the surest people [px]; of all where none is sure."""
    each = suppress(people, SAME_PERSON_IOU)
    tall = each.boxes[:, 3] - each.boxes[:, 1]
    sure = each.scores >= MIN_GROUP_SCORE
    return np.asarray(tall[sure] if sure.any() else tall)


def find_small(people: People, shape: tuple[int, ...], step: tuple[float, float]) -> list[Part]:
    """Return the tiles around a frame's people, if half of them are smaller than a limit.

    The surest people in the frame of a height, width [px] decide; where none is sure, all do. The
    step is one of `STEPS`.
    """
    sure = _sure_heights(people)
    if not len(sure) or np.median(sure) >= step[0]:
        return []
    each = suppress(people, SAME_PERSON_IOU)
    tall = each.boxes[:, 3] - each.boxes[:, 1]
    return _tile(each.boxes[tall < 2.0 * step[0]], shape, step)


def expect_parts(camera: Camera, pitch: PitchTemplate, margin: float) -> list[Part]:
    """Return the parts in which a calibrated camera shows people on the pitch too small or large.

    Where they are too large, the part is the whole frame: a pass over it costs a quarter of the
    first. The margin is around the pitch [m].
    """
    half = np.array([pitch.length, pitch.width]) / 2
    # People are expected at positions 2 m apart, 1.8 m tall.
    x, y = np.meshgrid(
        *(np.linspace(-(to + margin), to + margin, round(2 * (to + margin) / 2.0)) for to in half)
    )
    ground = pitch.height(np.clip(x, -half[0], half[0]), np.clip(y, -half[1], half[1]))
    feet = np.stack([x, y, ground], axis=-1).reshape(-1, 3)
    low = camera.project(feet)
    high = camera.project(feet + np.array([0.0, 0.0, 1.8]))
    tall = np.linalg.norm(high - low, axis=1)
    middle = 0.5 * (low + high)
    width, height = (int(side) for side in camera.image_size)
    with np.errstate(invalid="ignore"):
        shown = np.all((middle >= 0.0) & (middle <= [width, height]), axis=1)
    bounds = [limit for limit, _ in STEPS[1:]] + [0.0]
    parts = []
    for step, least in zip(STEPS, bounds, strict=True):
        asked = shown & (tall < step[0]) & (tall >= least)
        side = 0.5 * tall[asked, None]
        boxes = np.concatenate([middle[asked] - side, middle[asked] + side], axis=1)
        parts += _tile(boxes, (height, width), step)
    inner = np.array([-0.5, -0.5, width - 0.5, height - 0.5])
    for limit, zoom in reversed(REDUCTIONS):
        if np.any(shown & (tall > limit)):
            taller = (limit / BLEND, float("inf"))
            replaced = (limit * BLEND, float("inf"))
            parts.append(Part((0, 0), (width, height), zoom, inner, taller, replaced))
    return parts


def _tile(boxes: Floats, shape: tuple[int, ...], step: tuple[float, float]) -> list[Part]:
    """Return equal tiles that cover boxes of small people with a margin; none without a box."""
    if not len(boxes):
        return []
    (limit, zoom), size = step, np.array([shape[1], shape[0]])
    low = np.maximum(boxes[:, :2].min(axis=0) - limit, -0.5)
    high = np.minimum(boxes[:, 2:].max(axis=0) + limit, size - 0.5)
    # Longest side of an enlarged tile without its margin [px]: bounds memory.
    counts = np.ceil(zoom * (high - low) / 1024).astype(int)
    x, y = (np.linspace(low[axis], high[axis], counts[axis] + 1) for axis in (0, 1))
    parts = []
    for row in range(counts[1]):
        for column in range(counts[0]):
            inner = np.array([x[column], y[row], x[column + 1], y[row + 1]])
            wide = inner + np.array([-limit, -limit, limit, limit])
            if not np.any(np.all((boxes[:, 2:] > wide[:2]) & (boxes[:, :2] < wide[2:]), axis=1)):
                continue
            corner = np.maximum(np.floor(wide[:2]), 0).astype(int)
            end = np.minimum(np.ceil(wide[2:]), size).astype(int)
            found, replaced = (0.0, BLEND * limit), (0.0, limit / BLEND)
            corners = (corner[0], corner[1]), (end[0], end[1])
            parts.append(Part(*corners, zoom, inner, found, replaced))
    return parts


def find_groups(people: People, shape: tuple[int, ...]) -> list[Part]:
    """Return the groups in a frame of a height, width [px] that need a second detection pass.

    There is one entry per enlargement.
    """
    sure = suppress(people, SAME_PERSON_IOU)
    boxes = sure.boxes[sure.scores >= MIN_GROUP_SCORE]
    # Neighbours in a group overlap more [1, intersection over union].
    near = (box_iou(boxes, boxes) > 0.15) | np.eye(len(boxes), dtype=np.bool_)
    member, before = np.arange(len(boxes)), np.empty(0, dtype=np.int64)
    while len(boxes) and not np.array_equal(member, before):  # each takes the first number around
        before, member = member, np.where(near, member, len(near)).min(axis=1)
    counts = np.bincount(member)
    boxes = boxes[np.lexsort((boxes[:, 3] - boxes[:, 1], member))]
    grouped = np.repeat(counts > 1, counts)
    boxes, counts = boxes[grouped], counts[counts > 1]
    if not len(counts):
        return []
    first = np.cumsum(counts) - counts
    heights = boxes[:, 3] - boxes[:, 1]
    median = 0.5 * (heights[first + (counts - 1) // 2] + heights[first + counts // 2])
    tall = median[:, None]
    low = np.minimum.reduceat(boxes[:, :2], first)
    high = np.maximum.reduceat(boxes[:, 2:], first)
    # People within a margin of a quarter of their height still belong to the group.
    inner = np.concatenate([low - 0.25 * tall, high + 0.25 * tall], axis=1)
    size = np.array([shape[1], shape[0]])
    corner = np.maximum(np.floor(low - 0.5 * tall), 0).astype(int)
    end = np.minimum(np.ceil(high + 0.5 * tall), size).astype(int)
    # No second pass costs more than the first, or enlarges by more than 3 [1].
    most = np.minimum(np.sqrt(size.prod() / (end - corner).prod(axis=1)), 3.0)
    # One pass per enlarged height [px]: the detector is trained on heights up to 160.
    zooms = np.minimum(np.array([100.0, 160.0]) / tall, most[:, None])
    return [
        Part((a, b), (c, d), zoom, inner[k], (0.5 * high_px, 2.0 * high_px))
        for k, (a, b, c, d) in enumerate(np.concatenate([corner, end], axis=1).tolist())
        for high_px in (float(median[k]),)
        for zoom in sorted(set(zooms[k].tolist()))
        if zoom >= 1.25  # else the group is large enough
    ]
