"""The search for changes of cameras within a clip: far ones while people are tracked, then all.

A far knock is taken back before people are tracked again. So are clocks, until they stay: a tracker
that follows people by a wrong clock loses those who run. Joints then show smaller changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import ClipArray, Integers, Singles
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from worldpose.geometry.cameras import Camera
from worldpose.tracking.tracker import Tracking
from worldpose.triangulation.camera_changes import (
    MeasuredChange,
    change_record,
    find_changes,
    is_by_chance,
    is_same_change,
    join_changes,
    refine_change,
    sum_clip,
)
from worldpose.triangulation.change_parts import Part
from worldpose.triangulation.change_sums import LOOSE
from worldpose.triangulation.lost_views import find_lost_views
from worldpose.triangulation.settings import TriangulationSettings


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
    detections, changes, is_false = open_detections(()), list[CameraChange](), False
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
            is_false = is_gone or is_vague or is_by_chance(after)
            if is_false:
                changes.pop()
            detections = open_detections(changes)
            if is_false:
                tracks = track(detections)
        lost = find_lost_views(cameras, detections, tracks.joints, fps)
        found = [change_record(each, names[each.camera], frame) for each in lost]
        views = [
            each
            for each in found
            if each.kind == "view" and not any(is_same_change(one, each, fps) for one in changes)
        ]
        if is_false or not views or len(changes) >= 2 * len(names):
            lost = [each for each in lost if each.kind == "clock"]
            clocks = _trace_clocks(cameras, fps, detections, tracks, track, lost)
            told = [change_record(each, names[each.camera], frame) for each in clocks]
            return FollowedClip(detections, tracks, (*changes, *told))
        changes.append(views[0])
        detections = open_detections(changes)


def _trace_clocks(
    cameras: Camera,
    fps: float,
    detections: KeypointDetections[ClipArray],
    tracks: Tracking,
    track: Callable[[KeypointDetections[ClipArray]], Tracking],
    lost: Sequence[MeasuredChange],
) -> list[MeasuredChange]:
    """Return the changes of clocks, by people who are tracked with them taken back.

    `lost` are those that keep people from meeting. Other arguments are as of `follow_changes`.
    """
    count = len(cameras.focal)
    index: NDArray[np.integer] = (first := tracks.detection_index)
    if count < 3 or not index.shape[2]:
        return []
    rows, clocks = np.arange(len(index)), list(lost)
    taken_back = np.zeros((count, len(rows)))
    for attempt in range(5):
        parts, late = [_clock_part(each) for each in clocks], np.zeros_like(taken_back)
        for part in parts:
            late[part.camera] += part.size[0] * part.share(rows, len(rows))
        if np.abs(late - taken_back).max() > 1.0:
            moved, taken_back = np.rint(late).astype(int), late
            index = _track_in_time(detections, moved, track) if moved.any() else first
        elif attempt:
            break
        people = detections.assign_people(index)
        known = [*(Part(c, "constant", 0, (0.0,)) for c in range(count)), *parts]
        settings = LOOSE if clocks else TriangulationSettings()
        sums = sum_clip(cameras, people, fps, rows, known, settings)
        found = find_changes(cameras, people, fps, rows, sums, start=parts)
        clocks = [_keep_row(each, clocks, fps) for each in found if each.kind == "clock"]
    told = {each.camera for each in clocks}
    at_ends = [each for each in lost if _is_at_an_end(each, len(rows), fps)]
    return [*clocks, *(each for each in at_ends if each.camera not in told)]


def _is_at_an_end(step: MeasuredChange, frames: int, fps: float) -> bool:
    """Return whether all rows before or after a step, two bins or more, may be its lost frames."""
    row, lost = step.row or 0, max(0.0, float(step.amount[4]))
    return 0.4 * fps <= min(row, frames - row) < 0.4 * fps + lost


def _keep_row(step: MeasuredChange, known: Sequence[MeasuredChange], fps: float) -> MeasuredChange:
    """Return a step at the row where it was found first: moved rows have gaps around it."""
    rows = [each.row for each in known if each.camera == step.camera and each.row is not None]
    near = [row for row in rows if step.row is not None and abs(row - step.row) <= fps]
    return replace(step, row=near[0]) if near else step


def _clock_part(change: MeasuredChange) -> Part:
    size = (float(change.amount[4]),)
    if change.row is None:
        return Part(change.camera, "drift", 0, size)
    return Part(change.camera, "step", change.row, size)


def _track_in_time(
    detections: KeypointDetections[ClipArray],
    late: Integers,
    track: Callable[[KeypointDetections[ClipArray]], Tracking],
) -> NDArray[np.integer]:
    """Return people's detections (frames, cameras, persons), tracked with clocks taken back.

    Row t of camera c shows the time of row t + `late` (cameras, frames).
    """
    count, frames = late.shape
    source = np.full(late.shape, -1)
    for c in range(count):
        to = np.arange(frames) + late[c]
        inside = (to >= 0) & (to < frames)
        source[c, to[inside]] = np.flatnonzero(inside)
    arrays: dict[str, Any] = {
        name: _MovedRows(each, source) for name, each in detections.arrays().items()
    }
    moved = track(replace(detections, **arrays)).detection_index
    index = np.full_like(moved, -1)
    for c in range(count):
        to = np.flatnonzero(source[c] >= 0)
        index[source[c, to], c] = moved[to, c]
    return index


@dataclass(frozen=True, eq=False)
class _MovedRows:
    """An array (frames, cameras, ...) with rows of cameras at other places, read by frames.

    Attributes:
        array: the array.
        source: (cameras, frames) row that stands in a row; -1 = none, which is missing.
    """

    array: ClipArray
    source: Integers

    @property
    def shape(self) -> tuple[int, ...]:
        return self.array.shape

    def __getitem__(self, frames: slice | Integers, /) -> Singles:
        source = self.source[:, frames]
        first = int(source[source >= 0].min(initial=self.shape[0] - 1))
        seen = np.asarray(self.array[first : int(source.max(initial=first)) + 1])
        moved = seen[np.maximum(source - first, 0), np.arange(len(source))[:, None]].swapaxes(0, 1)
        moved[(source < 0).T] = np.nan
        return moved


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
    measured_clocks = {(names.index(one.camera), one.kind) for one in known}
    for each in measured:
        change = change_record(each, names[each.camera], frame)
        if is_by_chance(change):  # told, not taken back
            change = change.model_copy(update={"is_explained": False})
        same = [one for one in stay if is_same_change(one, change, fps)]
        if change.kind == "clock" and (each.camera, "clock") in measured_clocks:
            continue  # it was measured on people who were tracked by right clocks
        if not same:
            new.append(change)
        elif change.frame is None:  # the tracker measured the drift on the people that it had left
            stay[stay.index(same[0])] = join_changes(cameras[each.camera], same[0], change)
    return stay, new
