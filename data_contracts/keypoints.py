"""Detections of people: 2D keypoints, confidences, boxes and scores, in memory and in a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import TypeVar

from data_contracts.arrays import (
    AnyFloats,
    ClipArray,
    Flags,
    Floats,
    Integers,
    array_layout,
    array_layouts,
)
from data_contracts.conventions import COCO17

Array = TypeVar("Array", bound=ClipArray, default=AnyFloats, covariant=True)
"""Arrays of detections: NumPy's by default, or `ClipArray`, which also admits those of a store."""


def _no_frames() -> Integers:
    return np.empty(0, dtype=np.int64)


def _no_people() -> NDArray[np.integer]:
    return np.empty((0, 0, 0), dtype=np.int16)


def _as_floats(values: ArrayLike) -> AnyFloats:
    """Return an array of float32, or of float64 if the values are of neither, in rows of memory.

    Kernels are compiled again for every other layout.
    """
    array = np.asarray(values)
    kind = np.float32 if array.dtype.type is np.float32 else np.float64
    return array.astype(kind, order="C", copy=False)


@dataclass(frozen=True, eq=False)
class KeypointDetections(Generic[Array]):
    """Detected people, the record of keypoints from a detector to triangulation and filtering.

    The leading dimensions `...` are (frames, detections) for one camera, (frames, cameras,
    detections) for several cameras, and (detections,) for one image. Missing entries are NaN.

    The arrays of a `KeypointDetections[ClipArray]` can lie in a store; a slice of its frames, or an
    array of their indices, reads them into a `KeypointDetections` in memory.

    Attributes:
        keypoints: (..., 17, 2) [px], COCO-17; NaN where not found.
        confidence: (..., 17) in (0, 1]; NaN where not found.
        boxes: (..., 4) x0, y0, x1, y1 [px].
        score: (...) in (0, 1], confidence of each person.
        frame: (frames,) int64, frame numbers, rising; empty if the place of a row is its number,
            and for one image.
        detection_index: (frames, cameras, persons), each tracked person's detection; -1 = not seen.
            No frames before tracking.
        points: names of points that the detector gave besides COCO-17, such as `FEET`.
        extra_keypoints: (..., points, 2) [px], these points; NaN where not found. None without
            points.
        extra_confidence: (..., points) in (0, 1]; NaN where not found. None without points.
    """

    keypoints: Array
    confidence: Array
    boxes: Array
    score: Array
    frame: Integers = field(default_factory=_no_frames)
    detection_index: NDArray[np.integer] = field(default_factory=_no_people)
    points: tuple[str, ...] = ()
    extra_keypoints: Array | None = None
    extra_confidence: Array | None = None

    @staticmethod
    def from_keypoints(
        keypoints: ArrayLike,
        confidence: ArrayLike,
        detection_index: ArrayLike | None = None,
        frame: ArrayLike | None = None,
    ) -> KeypointDetections:
        """Return detections without boxes and scores, which are NaN and read-only."""
        keypoints, confidence = _as_floats(keypoints), _as_floats(confidence)
        shape = confidence.shape[:-1]
        nan = np.array(np.nan, dtype=confidence.dtype)
        number = np.asarray(() if frame is None else frame)
        with np.errstate(invalid="ignore"):
            whole = number.astype(np.int64)  # others stay: the functions that take them refuse
        return KeypointDetections(
            keypoints,
            confidence,
            np.broadcast_to(nan, (*shape, 4)),
            np.broadcast_to(nan, shape),
            whole if np.array_equal(whole, number) else number,
            _no_people() if detection_index is None else np.asarray(detection_index),
        )

    @staticmethod
    def empty() -> KeypointDetections:
        """Return the detections of an image without people."""
        return KeypointDetections.from_keypoints(np.empty((0, 17, 2)), np.empty((0, 17)))

    @staticmethod
    def from_arrays(stored: Mapping[Any, Any]) -> KeypointDetections:
        """Return stored detections.

        The arrays are those of `KEYPOINT_ARRAYS` and `frame`, by name, and those of `EXTRA_ARRAYS`
        with the names `point` if there are any.
        """
        names = [array.name for array in KEYPOINT_ARRAYS]
        points: tuple[str, ...] = ()
        if EXTRA_ARRAYS[0].name in stored:
            names += [array.name for array in EXTRA_ARRAYS]
            points = tuple(map(str, np.asarray(stored["point"]).tolist()))
        arrays: dict[str, Any] = {name: np.asarray(stored[name]) for name in names}
        return KeypointDetections(**arrays, frame=np.asarray(stored["frame"]), points=points)

    @staticmethod
    def concatenate(parts: Sequence[KeypointDetections]) -> KeypointDetections:
        """Return the detections of all parts, which have the same frames, cameras and points."""
        axis = parts[0].score.ndim - 1
        each = [part.arrays() for part in parts]
        return parts[0].with_arrays(
            {name: np.concatenate([part[name] for part in each], axis=axis) for name in each[0]},
            parts[0].frame,
        )

    @staticmethod
    def stack(cameras: Sequence[KeypointDetections]) -> KeypointDetections:
        """Return the detections of several cameras as (frames, cameras, detections).

        Each camera has (frames, detections). The result has every frame that a camera has; a
        camera's missing frames, detections and points are NaN.
        """
        if not cameras:
            none = np.empty((0, 0, 0, 17))
            return KeypointDetections.from_keypoints(np.stack([none, none], axis=-1), none)
        points = tuple(dict.fromkeys(point for each in cameras for point in each.points))
        cameras = [each.with_points(points) for each in cameras]
        frames = [each.numbers for each in cameras]
        frame = np.unique(np.concatenate(frames))
        most = max(each.score.shape[1] for each in cameras)
        stacked = {}
        for name, array in cameras[0].arrays().items():
            shape = (len(frame), len(cameras), most, *array.shape[2:])
            stacked[name] = np.full(shape, np.nan, dtype=array.dtype)
            for c, each in enumerate(cameras):
                rows = np.searchsorted(frame, frames[c])
                stacked[name][rows, c, : each.score.shape[1]] = each.arrays()[name]
        return cameras[0].with_arrays(stacked, frame)

    @property
    def numbers(self) -> Integers:
        """(frames,), the frame number of each row; none for one image."""
        shape = self.score.shape
        return self.frame if len(self.frame) or len(shape) < 2 else np.arange(shape[0])

    def __getitem__(self, frames: slice | Integers) -> KeypointDetections:
        """Return the detections of some rows of the frame dimension, in memory.

        A part of neighbouring rows keeps their numbers. Others have numbers if these are given.
        """
        arrays: dict[str, Any] = {name: array[frames] for name, array in self.arrays().items()}
        is_part = isinstance(frames, slice) and frames.step in (None, 1)
        numbers = self.numbers if is_part else self.frame
        return KeypointDetections(
            **arrays,
            frame=numbers[frames] if len(numbers) else numbers,
            detection_index=self.detection_index[frames]
            if len(self.detection_index)
            else self.detection_index,
            points=self.points,
        )

    def assign_people(self, detection_index: NDArray[np.integer]) -> KeypointDetections[Array]:
        """Return the detections of tracked people; argument as the attribute."""
        return replace(self, detection_index=detection_index)

    def select_person(self, person: int) -> KeypointDetections[Array]:
        """Return the same detections with one tracked person alone."""
        return self.assign_people(self.detection_index[:, :, person : person + 1])

    def by_person(self: KeypointDetections) -> tuple[Floats, Floats]:
        """Return keypoints (frames, cameras, persons, 17, 2) [px] and their confidence, by person.

        NaN and 0 where the person is not seen.
        """
        frames, cameras = np.ogrid[: len(self.keypoints), : self.keypoints.shape[1]]
        place = (frames[..., None], cameras[..., None], self.detection_index)
        keypoints, confidence = self.keypoints[place], self.confidence[place]
        seen = (self.detection_index >= 0)[..., None] & (confidence > 0.0)
        seen &= np.isfinite(keypoints).all(axis=-1)
        found: Floats = np.where(seen[..., None], keypoints, np.nan)
        return found, np.where(seen, confidence, 0.0)

    def select(
        self: KeypointDetections, detections: slice | NDArray[np.intp] | Flags
    ) -> KeypointDetections:
        """Return some detections of every frame (and camera), by index or by mask."""
        before = (slice(None),) * (self.score.ndim - 1)
        return self.with_arrays(
            {name: array[(*before, detections)] for name, array in self.arrays().items()},
            self.frame,
        )

    def without(self: KeypointDetections, keypoints: Flags) -> KeypointDetections:
        """Return the detections without the marked keypoints (..., 17), which become NaN.

        Other points stay.
        """
        return replace(
            self,
            keypoints=np.where(keypoints[..., None], np.nan, self.keypoints),
            confidence=np.where(keypoints, np.nan, self.confidence),
        )

    def reindex(self: KeypointDetections, frame: Integers) -> KeypointDetections:
        """Return the detections on exactly these rising frames (n,); missing frames are NaN.

        Nobody is seen in missing frames: their `detection_index` is -1.
        """
        kept = np.flatnonzero(np.isin(self.numbers, frame))
        row = np.searchsorted(frame, self.numbers[kept])
        padded = {}
        for name, array in self.arrays().items():
            padded[name] = np.full((len(frame), *array.shape[1:]), np.nan, dtype=np.float32)
            padded[name][row] = array[kept]
        found, index = self.with_arrays(padded, frame), self.detection_index
        if not len(index):
            return found
        people = np.full((len(frame), *index.shape[1:]), -1, dtype=index.dtype)
        people[row] = index[kept]
        return found.assign_people(people)

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by their names in a store, `KEYPOINT_ARRAYS` and `EXTRA_ARRAYS`."""
        arrays = {
            "keypoints": self.keypoints,
            "confidence": self.confidence,
            "boxes": self.boxes,
            "score": self.score,
        }
        if self.extra_keypoints is not None and self.extra_confidence is not None:
            arrays["extra_keypoints"] = self.extra_keypoints
            arrays["extra_confidence"] = self.extra_confidence
        return arrays

    def labels(self) -> dict[str, list[str]]:
        """Return the attribute `POINT_ATTRIBUTE` of a result with these arrays."""
        return {"point": list(self.points)} if self.points else {}

    def with_arrays(
        self: KeypointDetections, arrays: Mapping[str, AnyFloats], frame: Integers
    ) -> KeypointDetections:
        """Return detections of the same points with other arrays, named as those of `arrays`."""
        every: dict[str, Any] = dict(arrays)
        return KeypointDetections(frame=frame, points=self.points, **every)

    def add_points(
        self: KeypointDetections,
        points: tuple[str, ...],
        keypoints: AnyFloats,
        confidence: AnyFloats,
    ) -> KeypointDetections:
        """Return the detections with these points besides COCO-17 and no others.

        Keypoints are (..., points, 2) [px], their confidence (..., points); NaN where not found.
        """
        return replace(self, points=points, extra_keypoints=keypoints, extra_confidence=confidence)

    def select_points(self: KeypointDetections) -> KeypointDetections:
        """Return the points besides COCO-17 in place of the keypoints of COCO-17.

        So they are triangulated like those.
        """
        keypoints, confidence = self.extra_keypoints, self.extra_confidence
        if keypoints is None or confidence is None:
            shape = self.score.shape
            keypoints, confidence = np.empty((*shape, 0, 2)), np.empty((*shape, 0))
        return replace(
            self,
            keypoints=keypoints,
            confidence=confidence,
            points=(),
            extra_keypoints=None,
            extra_confidence=None,
        )

    def with_points(self: KeypointDetections, points: tuple[str, ...]) -> KeypointDetections:
        """Return the detections with exactly these points besides COCO-17; absent ones are NaN."""
        if points == self.points:
            return self
        if not points:
            return replace(self, points=(), extra_keypoints=None, extra_confidence=None)
        keypoints = np.full((*self.score.shape, len(points), 2), np.nan, self.keypoints.dtype)
        confidence = np.full(keypoints.shape[:-1], np.nan, self.confidence.dtype)
        if self.extra_keypoints is not None and self.extra_confidence is not None:
            both = [point for point in points if point in self.points]
            to, of = [points.index(each) for each in both], [self.points.index(p) for p in both]
            keypoints[..., to, :] = self.extra_keypoints[..., of, :]
            confidence[..., to] = self.extra_confidence[..., of]
        return replace(self, points=points, extra_keypoints=keypoints, extra_confidence=confidence)


class TrackedFrames(Protocol):
    """Detections of tracked people that are read by frames; `KeypointDetections` are some."""

    @property
    def detection_index(self) -> NDArray[np.integer]:
        """(frames, cameras, persons), as of `KeypointDetections`."""

    def __getitem__(self, frames: slice | Integers) -> KeypointDetections:
        """Return the detections in some frames, in memory."""


KEYPOINT_LABELS: dict[str, tuple[str, ...]] = {
    "joint": COCO17,
    "axis": ("x", "y"),
    "corner": ("x0", "y0", "x1", "y1"),
}

FRAME = array_layout("frame", "(frame) int64 [frame]", "match frame")

KEYPOINT_ARRAYS = array_layouts(
    """
    keypoints (*frame, detection, joint, axis) float32 [px], missing nan:
        detected 2D joints; the index of a detection in its frame identifies it
    confidence (*frame, detection, joint) float32 [1], missing nan:
        the detector's confidence of each keypoint, in (0, 1]
    boxes (*frame, detection, corner) float32 [px], missing nan:
        bounding boxes
    score (*frame, detection) float32 [1], missing nan:
        the detector's confidence of each person
    """
)
"""Arrays of the people one camera saw; the detection dimension is padded with missing values."""

EXTRA_ARRAYS = array_layouts(
    """
    extra_keypoints (*frame, detection, point, axis) float32 [px], missing nan:
        detected points besides COCO-17, such as heels and toes; attribute `point` names them
    extra_confidence (*frame, detection, point) float32 [1], missing nan:
        the detector's confidence of each of these points, in (0, 1]
    """
)
"""Arrays of points besides COCO-17; absent where the detector gave none."""
POINT_ATTRIBUTE = {"point": "names of the points besides COCO-17; absent without any"}
"""The attribute that labels the dimension of `EXTRA_ARRAYS`."""
OPTIONAL_POINTS = (*(array.name for array in EXTRA_ARRAYS), *POINT_ATTRIBUTE)
"""Arrays and attribute that a result without such points lacks."""
