"""Detections of people in one camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Observations:
    """Detected people of one camera, per frame; missing entries are NaN.

    Attributes:
        frame: (frames,) int64, frame numbers, rising.
        keypoints: (frames, detections, 17, 2) float32 [px], COCO-17; NaN where not found.
        confidence: (frames, detections, 17) float32 in (0, 1]; NaN where not found.
        boxes: (frames, detections, 4) float32 x0, y0, x1, y1 [px].
        score: (frames, detections) float32, the detector's confidence of each person.
    """

    frame: NDArray[np.int64]
    keypoints: NDArray[np.float32]
    confidence: NDArray[np.float32]
    boxes: NDArray[np.float32]
    score: NDArray[np.float32]

    def rows(self, rows: slice | NDArray[np.intp]) -> Observations:
        """Return the people on some rows of the frame dimension."""
        return Observations(
            frame=self.frame[rows],
            keypoints=self.keypoints[rows],
            confidence=self.confidence[rows],
            boxes=self.boxes[rows],
            score=self.score[rows],
        )

    def on_frames(self, frame: NDArray[np.int64]) -> Observations:
        """Return the people on exactly these rising frames (n,); missing frames are NaN."""
        kept = self.rows(np.flatnonzero(np.isin(self.frame, frame)))
        row = np.searchsorted(frame, kept.frame)
        padded = {}
        for name, array in kept.arrays().items():
            padded[name] = np.full((len(frame), *array.shape[1:]), np.nan, dtype=np.float32)
            padded[name][row] = array
        return Observations(frame=frame, **padded)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return the stored arrays by name, as in `data_contracts.observations`."""
        return {
            "keypoints": self.keypoints,
            "confidence": self.confidence,
            "boxes": self.boxes,
            "score": self.score,
        }
