"""Matches of predicted tracks to true people: by boxes, by distance or after registration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worldpose.errors import InputError
from worldpose.evaluation.boxes import box_overlaps, joint_boxes
from worldpose.evaluation.matching import (
    joint_distances,
    match_boxes,
    match_people,
    merge_tracks,
)
from worldpose.evaluation.registration import register_world
from worldpose.evaluation.settings import EvaluationSettings
from worldpose.geometry import Camera


def match_tracks(
    people: NDArray[np.float64],
    true: NDArray[np.float64],
    distances: NDArray[np.float64],
    match: NDArray[np.int64],
    camera: Camera | None,
    boxes: NDArray[np.float64] | None,
    settings: EvaluationSettings,
) -> NDArray[np.int64]:
    """Return the predicted person of each true one (frames, true), by whole tracks (E3).

    Args:
        people: (frames, predicted persons, 17, 3) [m]; NaN where missing.
        true: (frames, true persons, 17, 3) [m]; NaN where missing.
        distances: (frames, true persons, predicted persons) [m] of all pairs.
        match: (frames, true persons), matches by these distances.
        camera: compares boxes in its image; None = match by distance.
        boxes: (frames, predicted persons, 4) [px] of the prediction there; None = of its joints.
        settings: minimum overlap, gate, and threshold for registration.

    Raises:
        InputError: camera and truth have different numbers of frames.
    """
    if camera is not None:
        if camera.batch_shape not in ((), (1,), (len(true),)):
            raise InputError(
                "camera to match in",
                expected=f"one row, or {len(true)}: one for each frame of the reference",
                found=f"{camera.batch_shape}",
                todo="Name the camera of the clip that the reference belongs to.",
            )
        found = joint_boxes(people, camera) if boxes is None else boxes
        overlap = box_overlaps(found, joint_boxes(true, camera))
        cost = np.where(np.isnan(overlap), np.inf, 1.0 - overlap)
        return merge_tracks(match_boxes(overlap, settings.min_overlap), cost)
    possible = min(
        int(np.isfinite(side[..., 0]).any(-1).sum())
        for side in (people, true[np.isfinite(people[..., 0]).any((-1, -2))])
    )
    if (match >= 0).sum() < settings.min_matched_share * possible:
        motion = register_world(people, true, settings.match_gate)
        if motion is not None:
            moved = motion.apply(people.reshape(len(people), -1, 3)).reshape(people.shape)
            distances = joint_distances(moved, true)
            match = match_people(distances, settings.match_gate)
    return merge_tracks(match, distances)
