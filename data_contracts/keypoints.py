"""Detections of people: 2D keypoints, confidences, boxes and scores, in memory and in a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import AnyFloats, ArrayLayout, Flags, Integers
from data_contracts.conventions import COCO17


def _no_frames() -> Integers:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class KeypointDetections:
    """Detected people, the record from a detector to the store.

    The leading dimensions `...` are (frames, detections) for one camera, (frames, cameras,
    detections) for several cameras, and (detections,) for one image. Missing entries are NaN.
    After tracking, `TrackedDetections` also holds which detection is which person.

    Attributes:
        keypoints: (..., 17, 2) [px], COCO-17; NaN where not found.
        confidence: (..., 17) in (0, 1]; NaN where not found.
        boxes: (..., 4) x0, y0, x1, y1 [px].
        score: (...) in (0, 1], confidence of each person.
        frame: (frames,) int64, frame numbers, rising; empty if the place of a row is its number,
            and for one image.
    """

    keypoints: AnyFloats
    confidence: AnyFloats
    boxes: AnyFloats
    score: AnyFloats
    frame: Integers = field(default_factory=_no_frames)

    @classmethod
    def from_keypoints(cls, keypoints: AnyFloats, confidence: AnyFloats) -> KeypointDetections:
        """Return detections without boxes and scores, which are NaN and read-only."""
        shape = confidence.shape[:-1]
        nan = np.array(np.nan, dtype=confidence.dtype)
        return cls(
            keypoints, confidence, np.broadcast_to(nan, (*shape, 4)), np.broadcast_to(nan, shape)
        )

    @classmethod
    def empty(cls) -> KeypointDetections:
        """Return the detections of an image without people."""
        return cls.from_keypoints(np.empty((0, 17, 2)), np.empty((0, 17)))

    @classmethod
    def from_arrays(cls, stored: Mapping[Any, Any]) -> KeypointDetections:
        """Return stored detections.

        Args:
            stored: arrays by name, those of `KEYPOINT_ARRAYS` and `frame`.
        """
        return cls(
            keypoints=np.asarray(stored["keypoints"]),
            confidence=np.asarray(stored["confidence"]),
            boxes=np.asarray(stored["boxes"]),
            score=np.asarray(stored["score"]),
            frame=np.asarray(stored["frame"]),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[KeypointDetections]) -> KeypointDetections:
        """Return the detections of all parts, which have the same frames (and cameras)."""
        axis = parts[0].score.ndim - 1
        return cls(
            keypoints=np.concatenate([part.keypoints for part in parts], axis=axis),
            confidence=np.concatenate([part.confidence for part in parts], axis=axis),
            boxes=np.concatenate([part.boxes for part in parts], axis=axis),
            score=np.concatenate([part.score for part in parts], axis=axis),
            frame=parts[0].frame,
        )

    @classmethod
    def stack(cls, cameras: Sequence[KeypointDetections]) -> KeypointDetections:
        """Return the detections of several cameras as (frames, cameras, detections).

        Args:
            cameras: (frames, detections) of each camera. The result has every frame that a camera
                has; a camera's missing frames and detections are NaN.
        """
        frame = np.unique(np.concatenate([each.frame for each in cameras]))
        most = max(each.score.shape[1] for each in cameras)
        stacked = {}
        for name, array in cameras[0].arrays().items():
            shape = (len(frame), len(cameras), most, *array.shape[2:])
            stacked[name] = np.full(shape, np.nan, dtype=array.dtype)
            for c, each in enumerate(cameras):
                rows = np.searchsorted(frame, each.frame)
                stacked[name][rows, c, : each.score.shape[1]] = each.arrays()[name]
        return cls(frame=frame, **stacked)

    def __getitem__(self, frames: slice | NDArray[np.intp]) -> KeypointDetections:
        """Return the detections of some rows of the frame dimension."""
        return KeypointDetections(
            keypoints=self.keypoints[frames],
            confidence=self.confidence[frames],
            boxes=self.boxes[frames],
            score=self.score[frames],
            frame=self.frame[frames] if len(self.frame) else self.frame,
        )

    def select(self, detections: slice | NDArray[np.intp] | Flags) -> KeypointDetections:
        """Return some detections of every frame (and camera), by index or by mask."""
        return KeypointDetections(
            keypoints=self.keypoints[..., detections, :, :],
            confidence=self.confidence[..., detections, :],
            boxes=self.boxes[..., detections, :],
            score=self.score[..., detections],
            frame=self.frame,
        )

    def without(self, keypoints: Flags) -> KeypointDetections:
        """Return the detections without the marked keypoints (..., 17), which become NaN."""
        return replace(
            self,
            keypoints=np.where(keypoints[..., None], np.nan, self.keypoints),
            confidence=np.where(keypoints, np.nan, self.confidence),
        )

    def reindex(self, frame: Integers) -> KeypointDetections:
        """Return the detections on exactly these rising frames (n,); missing frames are NaN."""
        kept = self[np.flatnonzero(np.isin(self.frame, frame))]
        row = np.searchsorted(frame, kept.frame)
        padded = {}
        for name, array in kept.arrays().items():
            padded[name] = np.full((len(frame), *array.shape[1:]), np.nan, dtype=np.float32)
            padded[name][row] = array
        return KeypointDetections(frame=frame, **padded)

    def arrays(self) -> dict[str, AnyFloats]:
        """Return the arrays by their names in a store, `KEYPOINT_ARRAYS`."""
        return {
            "keypoints": self.keypoints,
            "confidence": self.confidence,
            "boxes": self.boxes,
            "score": self.score,
        }


@dataclass(frozen=True, eq=False)
class TrackedDetections:
    """Detected keypoints of all cameras in some frames, and which detection is which person.

    Attributes:
        keypoints: (frames, cameras, detections, 17, 2) [px]; NaN where not found.
        confidence: (frames, cameras, detections, 17) in (0, 1]; NaN, 0 or less leaves a keypoint
            out.
        detection_index: (frames, cameras, persons), each person's detection; -1 = not seen.
    """

    keypoints: AnyFloats
    confidence: AnyFloats
    detection_index: NDArray[np.integer]

    def __getitem__(self, frames: slice | NDArray[np.integer]) -> TrackedDetections:
        """Return some frames."""
        return TrackedDetections(
            self.keypoints[frames], self.confidence[frames], self.detection_index[frames]
        )

    def select_person(self, person: int) -> TrackedDetections:
        """Return the same detections with one person alone."""
        return replace(self, detection_index=self.detection_index[:, :, person : person + 1])


KEYPOINT_LABELS: dict[str, tuple[str, ...]] = {
    "joint": COCO17,
    "axis": ("x", "y"),
    "corner": ("x0", "y0", "x1", "y1"),
}

FRAME = ArrayLayout(
    name="frame",
    dims=("frame",),
    dtype="int64",
    unit="frame",
    missing="none",
    about="match frame",
)

KEYPOINT_ARRAYS = (
    ArrayLayout(
        name="keypoints",
        dims=("frame", "detection", "joint", "axis"),
        dtype="float32",
        unit="px",
        missing="nan",
        about="detected 2D joints; the index of a detection in its frame identifies it",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="confidence",
        dims=("frame", "detection", "joint"),
        dtype="float32",
        unit="1",
        missing="nan",
        about="the detector's confidence of each keypoint, in (0, 1]",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="boxes",
        dims=("frame", "detection", "corner"),
        dtype="float32",
        unit="px",
        missing="nan",
        about="bounding boxes",
        chunk_dim="frame",
    ),
    ArrayLayout(
        name="score",
        dims=("frame", "detection"),
        dtype="float32",
        unit="1",
        missing="nan",
        about="the detector's confidence of each person",
        chunk_dim="frame",
    ),
)
"""Arrays of the people one camera saw; the detection dimension is padded with missing values."""
