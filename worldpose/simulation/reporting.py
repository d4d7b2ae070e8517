"""Detections as a camera reports them: shuffled, with boxes and scores, and with lost frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats
from data_contracts.keypoints import KeypointDetections
from worldpose.simulation.detecting import Detections

ROOM: Final = 0.06
"""Margin of a box around the keypoints, for head, hands and feet [person height]."""


@dataclass(frozen=True, eq=False)
class Report:
    """A camera's detections and their persons.

    Attributes:
        observations: input of the factory.
        person: (frames, detections) int16, the body of every detection, -1 for padding.
        displaced: (frames, detections, 17), joints with gross errors.
    """

    observations: KeypointDetections
    person: NDArray[np.int16]
    displaced: Flags


def report(
    first_frame: int,
    detections: Detections,
    size: Floats,
    dropped: Flags,
    rng: np.random.Generator,
) -> Report:
    """Return detections in shuffled order, and the body of each.

    Args:
        first_frame: number of the first frame.
        detections: of all bodies, including false positives.
        size: (frames, bodies) [px]; scales the margins of boxes.
        dropped: (frames,), frames without any detection.
        rng: shuffles every frame independently.
    """
    found = np.isfinite(detections.confidence).any(-1) & ~dropped[:, None]
    boxes = _boxes(detections, size, found)
    order = np.argsort(np.where(found, rng.random(found.shape), np.inf), axis=1)
    order = order[:, : int(found.sum(axis=1).max(initial=0))]
    found = np.take_along_axis(found, order, axis=1)
    keypoints = np.take_along_axis(detections.keypoints, order[..., None, None], axis=1)
    confidence = np.take_along_axis(detections.confidence, order[..., None], axis=1)
    displaced = np.take_along_axis(detections.displaced, order[..., None], axis=1)
    # Padding has neither box nor score: reports omit detections without keypoints.
    keypoints[~found], confidence[~found] = np.nan, np.nan
    boxes = np.take_along_axis(boxes, order[..., None], axis=1)
    joints = np.maximum(np.isfinite(confidence).sum(-1), 1)
    score = np.where(found, np.nansum(confidence, axis=-1) / joints, np.nan)
    observations = KeypointDetections(
        frame=np.arange(first_frame, first_frame + len(found), dtype=np.int64),
        keypoints=keypoints.astype(np.float32),
        confidence=confidence.astype(np.float32),
        boxes=boxes.astype(np.float32),
        score=score.astype(np.float32),
    )
    person = np.where(found, order, -1).astype(np.int16)
    return Report(observations, person, displaced & found[..., None])


def _boxes(detections: Detections, size: Floats, found: Flags) -> Floats:
    """Return boxes (frames, bodies, 4) [px]; a merged one includes the lost person's width."""
    room = ROOM * size[..., None]
    missing = np.isnan(detections.keypoints)
    low = np.where(missing, np.inf, detections.keypoints).min(axis=2) - room
    high = np.where(missing, -np.inf, detections.keypoints).max(axis=2) + room
    frame, lost = np.nonzero(detections.merged_into >= 0)
    into = detections.merged_into[frame, lost].astype(np.intp)
    # Most of the lost person is hidden: half the person's width shows on the far side.
    half = 0.2 * size[frame, lost]
    side = np.where(lost % 2 == 0, 1.0, -1.0)
    low[frame, into, 0] -= np.where(side < 0.0, half, 0.0)
    high[frame, into, 0] += np.where(side > 0.0, half, 0.0)
    return np.where(found[..., None], np.concatenate([low, high], axis=-1), np.nan)
