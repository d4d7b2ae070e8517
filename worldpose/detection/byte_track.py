"""2D tracking of the boxes of one camera (ByteTrack, Zhang et al. 2022)."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_contracts.arrays import Floats, Integers
from worldpose.detection.boxes import overlaps

SURE_OVERLAP: Final = 0.2
"""A high-score box continues a track whose predicted box it overlaps more [1]: a small box moves by
half of its width per frame."""
DOUBTFUL_OVERLAP: Final = 0.5
"""A low-score box must lie near the prediction."""
PLACE_NOISE: Final = 1.0 / 20.0
"""Standard deviation of a box's position and size, over its height [1]; ByteTrack's."""
SPEED_NOISE: Final = 1.0 / 160.0
"""Standard deviation of their change per frame, over the height [1/frame]; ByteTrack's."""

_STEP = np.eye(8) + np.eye(8, k=4)
"""Transition matrix: speeds move positions."""


class BoxTracker:
    """Tracks of one camera.

    A Kalman filter per track estimates the centre, width and height of its box and their change
    per frame. High-score boxes are assigned to tracks first. Low-score boxes only continue
    unmatched tracks that were seen in the previous frame, and they begin none: a partly occluded
    person keeps the track, and a flickering box in the crowd does not become one.
    """

    def __init__(self, high_score_threshold: float, track_buffer_frames: int) -> None:
        """Begin without tracks.

        Args:
            high_score_threshold: score from which on a box may begin a track [1].
            track_buffer_frames: frames after which an unseen track ends.
        """
        self._high_score = high_score_threshold
        self._buffer = track_buffer_frames
        self._mean: Floats = np.empty((0, 8))
        self._covariance: Floats = np.empty((0, 8, 8))
        self._id: Integers = np.empty(0, dtype=np.int64)
        self._unseen: Integers = np.empty(0, dtype=np.int64)
        self._next = 0

    def follow(self, boxes: Floats, scores: Floats, frames: int = 1) -> Integers:
        """Return the track of each box (boxes,), -1 for low-score boxes that continue none.

        Args:
            boxes: (boxes, 4) x0, y0, x1, y1 [px] of the next frame in which people were detected.
            scores: (boxes,).
            frames: number of frames since the previous call's frame.
        """
        for _ in range(frames):
            self._predict()
        self._unseen += frames
        track = np.full(len(boxes), -1, dtype=np.int64)
        seen = np.zeros(len(self._id), dtype=np.bool_)
        expected = _as_boxes(self._mean)
        sure = scores >= self._high_score
        for candidates, tracks, least in (
            (np.flatnonzero(sure), np.ones_like(seen), SURE_OVERLAP),
            (np.flatnonzero(~sure), self._unseen == frames, DOUBTFUL_OVERLAP),
        ):
            rows = np.flatnonzero(tracks & ~seen)
            for row, box in _assigned(expected[rows], boxes[candidates], least):
                track[candidates[box]] = rows[row]
                seen[rows[row]] = True
        matched = track >= 0
        self._update(track[matched], boxes[matched])
        ids = np.where(matched, self._id[track] if len(self._id) else -1, -1)
        self._unseen[seen] = 0
        self._forget()
        new = np.flatnonzero(sure & ~matched)
        ids[new] = self._begin(boxes[new])
        return np.asarray(ids, dtype=np.int64)

    def _predict(self) -> None:
        self._mean = self._mean @ _STEP.T
        noise = self._noise(PLACE_NOISE, SPEED_NOISE)
        self._covariance = _STEP @ self._covariance @ _STEP.T + noise

    def _noise(self, place: float, speed: float) -> Floats:
        scale = np.repeat([place, speed], 4) * np.maximum(self._mean[:, 3:4], 1.0)
        return np.asarray(np.eye(8) * (scale**2)[:, None, :])

    def _update(self, rows: Integers, boxes: Floats) -> None:
        mean, covariance = self._mean[rows], self._covariance[rows]
        spread = np.eye(4) * (PLACE_NOISE * np.maximum(mean[:, 3], 1.0))[:, None, None] ** 2
        gain = covariance[:, :, :4] @ np.linalg.inv(covariance[:, :4, :4] + spread)
        residual = _as_states(boxes) - mean[:, :4]
        self._mean[rows] = mean + (gain @ residual[..., None])[..., 0]
        self._covariance[rows] = covariance - gain @ covariance[:, :4, :]

    def _forget(self) -> None:
        kept = self._unseen <= self._buffer
        self._mean, self._covariance = self._mean[kept], self._covariance[kept]
        self._id, self._unseen = self._id[kept], self._unseen[kept]

    def _begin(self, boxes: Floats) -> Integers:
        states = _as_states(boxes)
        ids = self._next + np.arange(len(boxes))
        self._next += len(boxes)
        scale = np.repeat([2.0 * PLACE_NOISE, 10.0 * SPEED_NOISE], 4) * states[:, 3:4]
        self._mean = np.vstack([self._mean, np.hstack([states, np.zeros_like(states)])])
        self._covariance = np.concatenate([self._covariance, np.eye(8) * (scale**2)[:, None, :]])
        self._id = np.append(self._id, ids)
        self._unseen = np.append(self._unseen, np.zeros(len(boxes), dtype=np.int64))
        return ids


def _assigned(expected: Floats, boxes: Floats, least: float) -> list[tuple[int, int]]:
    """Return pairs of rows that overlap by more than `least`, with the largest total overlap."""
    shared = overlaps(expected, boxes)
    # A forbidden pair has value 0, so that it never displaces an allowed one.
    pairs = linear_sum_assignment(-np.where(shared > least, shared, 0.0))
    return [(int(a), int(b)) for a, b in zip(*pairs, strict=True) if shared[a, b] > least]


def _as_states(boxes: Floats) -> Floats:
    """Return the centre x, y, width, height of boxes (n, 4)."""
    size = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    return np.hstack([(boxes[:, :2] + boxes[:, 2:]) / 2.0, size])


def _as_boxes(means: Floats) -> Floats:
    """Return x0, y0, x1, y1 of states (n, 8)."""
    half = np.maximum(means[:, 2:4], 1.0) / 2.0
    return np.hstack([means[:, :2] - half, means[:, :2] + half])
