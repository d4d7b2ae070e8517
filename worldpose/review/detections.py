"""Replay of corrections over the keypoints and boxes of a detector (B3, D6)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.review import AddedDetection, DeletedDetection, MovedKeypoint

DetectionEdit: TypeAlias = AddedDetection | DeletedDetection | MovedKeypoint
DETECTION_EDITS = (AddedDetection, DeletedDetection, MovedKeypoint)
SAME: Final = 0.01
"""Maximum difference of equal keypoints [px]: the store has single precision, and pages show
rounded values."""


@dataclass(frozen=True, eq=False)
class DetectionReplay:
    """Detections of one camera with corrections applied.

    Attributes:
        observations: with corrections.
        objections: per edit the reason why it does not apply; None if it does.
    """

    observations: KeypointDetections
    objections: tuple[str | None, ...]


def replay_detections(found: KeypointDetections, edits: Iterable[DetectionEdit]) -> DetectionReplay:
    """Return the detections of one camera with corrections applied in order.

    An edit applies only if the current value equals its `was`. Corrected keypoints and added people
    have confidence 1; other keypoints, and the indices of detections, stay. If an added person
    exceeds the number of detections, every frame gets one more.

    Args:
        found: detected or given observations; not modified.
        edits: of this camera, in the order they were made.
    """
    changed = KeypointDetections(
        frame=found.frame,
        keypoints=found.keypoints.copy(),
        confidence=found.confidence.copy(),
        boxes=found.boxes.copy(),
        score=found.score.copy(),
    )
    objections = []
    for edit in edits:
        objection = find_objection(changed, edit)
        objections.append(objection)
        if objection is not None:
            continue
        at = np.searchsorted(changed.frame, edit.frame), edit.detection
        if isinstance(edit, DeletedDetection):
            for array in changed.arrays().values():
                array[at] = np.nan
        elif isinstance(edit, AddedDetection):
            changed = _with_place(changed, edit.detection)
            keypoints = np.array([xy or (np.nan, np.nan) for xy in edit.keypoints])
            changed.keypoints[at] = keypoints
            changed.confidence[at] = np.where(np.isnan(keypoints[:, 0]), np.nan, 1.0)
            changed.boxes[at] = edit.box
            changed.score[at] = 1.0
        else:
            joint = COCO17.index(edit.joint)
            changed.keypoints[(*at, joint)] = np.nan if edit.xy is None else edit.xy
            changed.confidence[(*at, joint)] = np.nan if edit.xy is None else 1.0
    return DetectionReplay(changed, tuple(objections))


def find_objection(found: KeypointDetections, edit: DetectionEdit) -> str | None:
    """Return why an edit does not apply to a camera's detections; None if it does."""
    place = f"detection {edit.detection} of {edit.camera} in frame {edit.frame}"
    row = _row(found, edit.frame)
    if row is None:
        return f"{edit.camera} has no frame {edit.frame}"
    places = found.score.shape[1]
    is_there = 0 <= edit.detection < places and not np.isnan(found.score[row, edit.detection])
    if isinstance(edit, AddedDetection):
        if edit.detection > places:
            return f"{place} would leave places free before it: {places} is the next"
        return f"there is a {place} already" if is_there else None
    if not is_there:
        return f"there is no {place}"
    if isinstance(edit, DeletedDetection):
        return None
    now = found.keypoints[row, edit.detection, COCO17.index(edit.joint)].astype(np.float64)
    if np.isnan(now).any():
        return f"{edit.joint} of {place} is not seen" if edit.was or edit.xy is None else None
    if edit.was is None or np.abs(now - edit.was).max() > SAME:
        was, seen = edit.was or "not seen", [round(float(value), 2) for value in now]
        return f"{edit.joint} of {place} was {was} when it was corrected, and is {seen} now"
    return None


def _with_place(found: KeypointDetections, detection: int) -> KeypointDetections:
    """Return observations with room for a detection index; new entries are NaN."""
    if detection < found.score.shape[1]:
        return found
    widened = {
        name: np.pad(array, [(0, 0), (0, 1)] + [(0, 0)] * (array.ndim - 2), constant_values=np.nan)
        for name, array in found.arrays().items()
    }
    return KeypointDetections(frame=found.frame, **widened)


def _row(found: KeypointDetections, frame: int) -> int | None:
    """Return the row of a match frame; None if the camera has no such frame."""
    row = int(np.searchsorted(found.frame, frame))
    return row if row < len(found.frame) and found.frame[row] == frame else None
