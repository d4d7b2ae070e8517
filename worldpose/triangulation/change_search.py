"""The search for changes of cameras within a clip: far ones while people are tracked, then all.

A far knock is taken back before people are tracked again. Their joints then show smaller changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from data_contracts.arrays import ClipArray, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from worldpose.geometry.cameras import Camera
from worldpose.tracking.tracker import Tracking
from worldpose.triangulation.camera_changes import (
    MeasuredChange,
    change_record,
    explains_clock,
    is_by_chance,
    is_same_change,
    join_changes,
    refine_change,
)
from worldpose.triangulation.lost_views import find_lost_views


@dataclass(frozen=True, eq=False)
class FollowedClip:
    """A clip whose cameras change: detections with far knocks taken back, and their tracks."""

    detections: KeypointDetections[ClipArray]
    tracks: Tracking
    changes: tuple[CameraChange, ...]


def follow_changes(
    names: Sequence[str],
    cameras: Camera,
    fps: float,
    open_detections: Callable[[Sequence[CameraChange]], KeypointDetections[ClipArray]],
    track: Callable[[KeypointDetections[ClipArray]], Tracking],
) -> FollowedClip:
    """Track people, and take far knocks of cameras back.

    One camera is corrected at a time: it spoils the people that the others meet. `open_detections`
    returns the clip with some changes of views taken back.
    """
    detections, changes = open_detections(()), list[CameraChange]()
    frame = np.asarray(detections.frame, dtype=np.int64)
    while True:
        tracks = track(detections)
        if changes:
            people = detections.assign_people(tracks.detection_index)
            before, camera = changes[-1], names.index(changes[-1].camera)
            after = refine_change(cameras, people, fps, camera, before)
            # Just before and after it, people show nothing of a change that is no sudden one.
            shift = math.hypot(*after.shift_px)
            is_gone = shift < 0.25 * math.hypot(*before.shift_px)
            if is_gone and before.frame is not None:
                changes[-1] = _slow_change(before)
                detections = open_detections(changes)
                continue
            changes[-1] = after
            # The few people of a short rest of the clip may meet others anywhere.
            is_vague = after.std is not None and shift < 3.0 * after.std
            if is_gone or is_vague or is_by_chance(after):
                detections = open_detections(changes[:-1])
                return FollowedClip(detections, track(detections), tuple(changes[:-1]))
            detections = open_detections(changes)
        lost = find_lost_views(cameras, detections, tracks.joints, fps)
        found = [change_record(each, names[each.camera], frame) for each in lost]
        views = [
            each
            for each in found
            if each.kind == "view" and not any(is_same_change(one, each, fps) for one in changes)
        ]
        if not views or len(changes) >= 2 * len(names):
            clocks = [each for each in found if each.kind == "clock"]
            return FollowedClip(detections, tracks, (*changes, *clocks))
        changes.append(views[0])
        detections = open_detections(changes)


def _slow_change(change: CameraChange) -> CameraChange:
    """Return a sudden change as one that grows over the clip to what is usual after its moment."""
    assert change.frame is not None
    begun = (change.frame - change.first_frame) / max(1.0, change.frame_count - 1.0)
    x, y = (2.0 * each / (1.0 + begun) for each in change.shift_px)
    return change.model_copy(update={"frame": None, "shift_px": (x, y)})


def add_changes(
    known: Sequence[CameraChange],
    measured: Sequence[MeasuredChange],
    names: Sequence[str],
    cameras: Camera,
    frame: Integers,
    fps: float,
) -> tuple[list[CameraChange], list[CameraChange]]:
    """Return the known changes that stay, and the further ones that joints show.

    `known` is what `follow_changes` found, `measured` what `find_changes` found with those taken
    back. `frame` (frames,) are the clip's match frames, `fps` of them a second [1/s].
    """
    stay, new = list(known), list[CameraChange]()
    for each in measured:
        change = change_record(each, names[each.camera], frame)
        if is_by_chance(change):  # told, not taken back
            change = change.model_copy(update={"is_explained": False})
        same = [one for one in stay if is_same_change(one, change, fps)]
        if not same:
            new.append(change)
        elif change.frame is None:  # the tracker measured the drift on the people that it had left
            stay[stay.index(same[0])] = join_changes(cameras[each.camera], same[0], change)
    steps = [each for each in new if each.kind == "clock" and each.frame is not None]
    stay = [one for one in stay if not any(_is_measured_again(one, each, fps) for each in steps)]
    return [each for each in stay if not explains_clock(new, each)], new


def _is_measured_again(known: CameraChange, step: CameraChange, fps: float) -> bool:
    """Return whether a step of a clock is one that the tracker measured, coarsely."""
    is_same = (known.camera, known.kind) == (step.camera, step.kind)
    if not is_same or known.frame is None or step.frame is None:
        return False
    return abs(known.frame - step.frame) <= fps
