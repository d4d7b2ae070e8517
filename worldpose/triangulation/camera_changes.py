"""Cameras that change within a clip, and how much: clocks that step or drift, views that move.

`camera_consistency.changes` finds a change from joints that the changed camera has displaced. Here
the change is corrected in the detections, people are triangulated again, and the rest is added,
until there is none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_contracts.arrays import AnyFloats, ClipArray, Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from worldpose.camera_consistency.changes import Change, Kind, find_changes, measure_step
from worldpose.camera_consistency.health import LIMBS, UNKNOWNS, CameraHealth
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.triangulation.clocks import read_frames
from worldpose.triangulation.noise_model import NoiseModel
from worldpose.triangulation.residuals import Observations, Rig
from worldpose.triangulation.settings import TriangulationSettings
from worldpose.triangulation.solve import solve_joints


@dataclass(frozen=True, eq=False)
class MeasuredChange:
    """A change of a camera with its size.

    Attributes:
        found: camera, kind and moment.
        amount: (5,) shift along x and y [px], zoom [1], roll [rad] and clock offset [frame] of the
            images after a sudden change, or at the end of the clip.
        std: standard deviation of its size [frame] or [px].
        is_explained: whether all cameras agree with the change corrected.
        is_left_out: whether its views are useless if the change does not explain them.
        before: offset of a changed clock before the change [frame].
    """

    found: Change
    amount: Floats
    std: float
    is_explained: bool = True
    is_left_out: bool = False
    before: float = 0.0

    def at(self, rows: Floats, frames: int) -> Floats:
        """Return the share (n,) of the change at rows of a clip of some frames."""
        if self.found.is_sudden:
            return np.asarray((rows >= self.found.row) * 1.0)
        return np.asarray(rows / max(1.0, frames - 1.0))


def explain_changes(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    settings: TriangulationSettings,
    found: Sequence[Change],
    kinds: Sequence[Kind] = ("clock", "view"),
) -> MeasuredChange | None:
    """Return the change of the camera without which the others agree; None if there is none.

    Args:
        cameras: batch (cameras,), at least three.
        people: detections of the tracked people of a clip.
        fps: frames per second [1/s].
        settings: noise of the keypoints.
        found: changes as `find_changes` finds them, at least one.
        kinds: what may change. Where people are spoilt, a clock can look like a view.
    """
    loose = settings.model_copy(update={"max_deviation": 30.0})
    trial = _Trial(cameras, people, fps, loose)
    change = _leave_one_out(trial, found, kinds)
    if change is not None and change.is_explained:
        return change
    # In a crowd, or where little changes, leaving out a camera tells less than a clear change.
    if found[0].gain < 300.0:
        return change
    windows, direct = trial.choose_windows(found[0]), trial.measure(found[0])
    before, after = trial.misfit(windows), trial.misfit(windows, direct)
    possible = before - trial.misfit(windows, without=found[0].camera)
    return direct if before - after > max(0.02 * before, 0.7 * possible) else change


def _leave_one_out(
    trial: _Trial, found: Sequence[Change], kinds: Sequence[Kind]
) -> MeasuredChange | None:
    """Return the change of the camera without which the others agree; None if there is none."""
    people, windows = trial.people, trial.choose_windows(found[0])
    before = trial.misfit(windows)
    # In a small rig a camera that sways spoils the others so that theirs are the changes found.
    count = len(trial.cameras.focal)
    suspects = range(count) if count <= 8 else {each.camera for each in found}
    without = {c: trial.misfit(windows, without=c) for c in suspects}
    culprit = min(without, key=lambda c: without[c])
    # One camera of many hardly counts in the mean.
    if before - without[culprit] < 0.25 * before / (count - 1):
        return None
    # Its change without its own share in the people, which hides a part.
    near = [each for each in found if each.camera == culprit] or list(found)
    alone, misfit = trial.find_alone(culprit, near[0], kinds)
    # Five real cameras that stand still have 0.9 to 1.7 times the misfit of the others.
    if misfit < 2.0 * without[culprit]:
        return None
    own = [trial.measure(each) for each in alone or near if each.camera == culprit]
    is_left_out = misfit > 8.0 * without[culprit]
    if not own:
        swaying = replace(near[0], camera=culprit, is_sudden=False)
        unknown = MeasuredChange(swaying, np.zeros(UNKNOWNS), np.inf)
        return replace(unknown, is_explained=False, is_left_out=is_left_out)
    after = [trial.misfit(windows, each) for each in own]
    best = int(np.argmin(after))
    # A camera that sways is not explained by one change.
    is_explained = before - after[best] > 0.7 * (before - without[culprit])
    # No recorder's clock runs 2 % fast: such a drift is steps that people hardly show.
    most = 0.02 * len(people.detection_index)
    is_explained &= own[best].found.is_sudden or abs(own[best].amount[4]) < most
    if not is_explained:
        # One of several knocks explains the seconds around it.
        around = replace(trial, seconds=2)
        steps = [each.found for each in own if each.found.is_sudden and each.found.kind == "view"]
        for step in map(around.measure, steps):
            windows = around.choose_windows(step.found)
            before, rest = around.misfit(windows), around.misfit(windows, without=culprit)
            if before - around.misfit(windows, step) > max(0.7 * (before - rest), 0.2 * before):
                return step
    return replace(own[best], is_explained=bool(is_explained), is_left_out=is_left_out)


def refine_change(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    settings: TriangulationSettings,
    camera: int,
    known: CameraChange,
) -> CameraChange:
    """Return a known sudden change of a view with what people show who were tracked through it.

    Args:
        cameras: batch (cameras,), at least three.
        people: detections of the tracked people of a clip, with the known change taken back.
        fps: frames per second [1/s].
        settings: noise of the keypoints.
        camera: index of the camera.
        known: its change.
    """
    row = int(np.searchsorted(people.frame, known.frame or 0))
    found = Change(camera, "view", True, row, 0.0, 0.0)
    measured = _Trial(cameras, people, fps, settings).measure(found)
    frame = np.asarray(people.frame, dtype=np.int64)
    return join_changes(known, change_record(measured, known.camera, frame))


@dataclass(frozen=True, eq=False)
class _Trial:
    """Windows of a clip, triangulated with a change corrected or without a camera."""

    cameras: Camera
    people: KeypointDetections[ClipArray]
    fps: float
    settings: TriangulationSettings
    seconds: int = 6

    def choose_windows(self, found: Change) -> list[slice]:
        """Return intervals of a second that a change leaves whole, some on both sides of it."""
        frames, length = len(self.people.detection_index), max(3, round(self.fps))
        # Half as many seconds of a large rig show as much, and take as long.
        share = 1 if length * self.people.detection_index[0].size < 10_000 else 2
        if not found.is_sudden:
            starts = range(0, max(1, frames - length + 1), length)
            chosen = np.unique(np.linspace(0, len(starts) - 1, 16 // share).astype(int))
            return [slice(starts[k], starts[k] + length) for k in chosen]
        # Not at the step: its place is known to some frames, and a clock's correction reads there.
        gap = length // 2
        ends = range(length, found.row - gap + 1, length)
        before = [slice(end - length, end) for end in ends]
        starts = range(found.row + gap, frames - length + 1, length)
        after = [slice(start, start + length) for start in starts]
        # Near an end of the clip, a part of a second has to do.
        if not before:
            before = [slice(0, max(3, found.row - gap // 2))]
        if not after:
            after = [slice(min(frames - 3, found.row + gap // 2), frames)]
        most = self.seconds // share
        return [*before[-most:], *after[:most]]

    def find_alone(
        self, camera: int, near: Change, kinds: Sequence[Kind]
    ) -> tuple[list[Change], float]:
        """Return a camera's changes and misfit [1] towards the people whom the others place."""
        frames = len(self.people.detection_index)
        first = 0 if frames <= 6000 else max(0, min(near.row, frames - 3000) - 1500)
        span = range(first, frames if frames <= 6000 else first + 3000)
        health = measure_departures(
            self.cameras, self.people, self.fps, self.settings, np.array(span), camera
        )
        changes = [
            replace(each, row=each.row + first)
            for each in find_changes(health, self.fps, kinds)
            if each.camera == camera
        ]
        return changes, float(health.misfit[camera])

    def measure(self, found: Change) -> MeasuredChange:
        """Return a change with its size."""
        measured = MeasuredChange(found, np.zeros(UNKNOWNS), np.inf)
        frames = len(self.people.detection_index)
        windows = self.choose_windows(found)
        middles = np.array([0.5 * (window.start + window.stop - 1) for window in windows])
        for _ in range(20):
            each = [self._look(window, measured)[0] for window in windows]
            sums = CameraHealth.empty(len(each), len(self.cameras.focal), 1, 5.0)
            for number, one in enumerate(each):
                sums.matrix[number] = one.matrix.sum(axis=0)
                sums.right[number] = one.right.sum(axis=0)
            change, std, rest = measure_step(sums, found, measured.at(middles, frames))
            amount, before = measured.amount + change, measured.before + rest
            measured = replace(measured, amount=amount, std=std, before=before)
            if max(np.abs(change).max(), abs(rest)) < 0.01:
                break
        return measured

    def misfit(
        self,
        windows: Sequence[slice],
        change: MeasuredChange | None = None,
        without: int | None = None,
    ) -> float:
        """Return the mean loss of the departures of all cameras, per degree of freedom [1]."""
        cost = freedom = 0.0
        for window in windows:
            one, joints = self._look(window, change, without)
            _, terms, loss = one.sums.sum(axis=(0, 1))
            cost += float(loss)
            freedom += 2.0 * float(terms) - 3.0 * joints
        return cost / max(1.0, freedom)

    def _look(
        self, window: slice, change: MeasuredChange | None, without: int | None = None
    ) -> tuple[CameraHealth, int]:
        """Return the departures in a window, and the number of joints."""
        cameras, seen = self.cameras, self.people[window]
        if change is not None:
            seen = correct_window(cameras, self.people, window, change)
        seen = _without(seen, without)
        joints = triangulate_views(cameras, seen, self.settings)
        one = CameraHealth.empty(len(joints), len(cameras.focal), joints.shape[1], self.fps)
        one.add(cameras, seen, joints, 0)
        return one, int(np.isfinite(joints[1:-1, :, LIMBS, 0]).sum())


def _without(seen: KeypointDetections, camera: int | None) -> KeypointDetections:
    """Return the people without the views of a camera."""
    if camera is None:
        return seen
    index = seen.detection_index.copy()
    index[:, camera] = -1
    return seen.assign_people(index)


def triangulate_views(
    cameras: Camera, seen: KeypointDetections, settings: TriangulationSettings
) -> Floats:
    """Return joints (frames, persons, 17, 3) [m] by the stated noise."""
    precision = NoiseModel.nominal(seen.confidence.shape[-1]).precision(seen.confidence)
    rig, index = Rig.from_cameras(cameras), seen.detection_index
    return solve_joints(Observations.of(rig, seen.keypoints, precision, index), settings).joints


def measure_departures(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    settings: TriangulationSettings,
    rows: Integers,
    without: int | None = None,
) -> CameraHealth:
    """Return the departures of cameras in some rows of a clip, `fps` of them per second.

    The people are placed by the stated noise, and `without` the views of a camera.
    """
    _, count, persons = people.detection_index.shape
    health, length = CameraHealth.empty(len(rows), count, persons, fps), 512
    for start in range(0, len(rows), length):
        part = slice(max(0, start - 1), start + length + 1)
        seen = people[rows[part]]
        joints = triangulate_views(cameras, _without(seen, without), settings)
        health.add(cameras, seen, joints, part.start)
    return health


def correct_window(
    cameras: Camera, people: KeypointDetections[ClipArray], window: slice, change: MeasuredChange
) -> KeypointDetections:
    """Return the people of some frames with a change corrected."""
    middle = 0.5 * (window.start + window.stop - 1)
    amount = change.amount * change.at(np.array([middle]), len(people.detection_index))
    c, late = change.found.camera, np.zeros(len(cameras.focal))
    late[c] = change.before + amount[4]
    seen = read_frames(people, window, late) if late[c] else people[window]
    keypoints = np.array(seen.keypoints, dtype=np.float64)
    keypoints[:, c] = move_back(keypoints[:, c], cameras[c], amount)
    return replace(seen, keypoints=keypoints)


def move_back(pixels: Floats, camera: Camera, amount: Floats) -> Floats:
    """Return the pixels (..., 2) that a camera had shown before its view changed."""
    back = np.asarray(np.linalg.inv(_view_motion(camera, amount)), dtype=np.float64)
    return _turn_view(pixels, camera, back)


def move_on(
    pixels: Floats, frame: Integers, camera: Camera, changes: Sequence[CameraChange]
) -> Floats:
    """Return the pixels (frames, ..., 2) of the unchanged camera where the changed one shows them.

    They are missing where nothing explains the camera's views. Later changes were found in views
    that the earlier ones had corrected.
    """
    moved: NDArray[np.float64] = np.array(pixels, dtype=np.float64)
    for change in reversed(changes):
        share = _shares(change, frame)
        for part in np.unique(share[share > 0.0]):
            motion = _view_motion(camera, np.asarray(part * _view_amount(change)))
            moved[share == part] = _turn_view(np.asarray(moved[share == part]), camera, motion)
        if change.is_left_out:
            moved[_inside(change, frame)] = np.nan
    return moved


def correct_views(
    pixels: AnyFloats,
    frame: Integers,
    cameras: Mapping[str, Camera],
    changes: Sequence[CameraChange],
) -> Floats:
    """Return keypoints (frames, cameras, detections, points, 2) as unchanged cameras show them."""
    moved: NDArray[np.float64] = np.array(pixels, dtype=np.float64)
    for change in changes:
        c, share = list(cameras).index(change.camera), _shares(change, frame)
        for part in np.unique(share[share > 0.0]):
            rows = share == part
            amount = part * _view_amount(change)
            moved[rows, c] = move_back(np.asarray(moved[rows, c]), cameras[change.camera], amount)
        if change.is_left_out:
            moved[_inside(change, frame), c] = np.nan
    return moved


def _view_motion(camera: Camera, amount: Floats) -> Floats:
    """Return the matrix (3, 3) of a turn and a zoom that change what a camera shows.

    The shift [px] is that at the principal point.
    """
    x, y, zoom, roll = amount[:4] / [camera.focal[0], camera.focal[1], 1.0, 1.0]
    turn = Rotation.from_rotvec([-y, x, roll]).as_matrix()
    return np.asarray([[1.0 + zoom], [1.0 + zoom], [1.0]] * turn)


def _turn_view(pixels: Floats, camera: Camera, motion: Floats) -> Floats:
    """Return where pixels (..., 2) of a camera lie after a motion of its view."""
    plane = camera.normalize(pixels.reshape(-1, 2))
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ motion.T
    return replace(camera, cam_from_world=Rigid.identity()).project(rays).reshape(pixels.shape)


def is_same_change(one: CameraChange, other: CameraChange, fps: float) -> bool:
    """Return whether two explained changes are one move of a camera, found within a second."""
    same = (one.camera, one.kind) == (other.camera, "view") == (other.camera, other.kind)
    if one.frame is None or other.frame is None:
        near = one.frame == other.frame
    else:
        near = abs(one.frame - other.frame) <= fps
    return same and near and other.is_explained


def is_by_chance(change: CameraChange) -> bool:
    """Return whether a change is more than a knock: people who agree nowhere seem to show it."""
    return abs(change.zoom) > 0.1 or abs(change.roll_rad) > np.radians(10.0)


def join_changes(first: CameraChange, then: CameraChange) -> CameraChange:
    """Return a change of a view with the little that was found after its correction."""
    x, y, zoom, roll = (_view_amount(first) + _view_amount(then)).tolist()
    return then.model_copy(update={"shift_px": (x, y), "zoom": zoom, "roll_rad": roll})


def _view_amount(change: CameraChange) -> Floats:
    return np.array([*change.shift_px, change.zoom, change.roll_rad])


def _inside(change: CameraChange, frame: Integers) -> Flags:
    after = frame - change.first_frame
    return np.asarray((after >= 0) & (after < change.frame_count))


def _shares(change: CameraChange, frame: Integers) -> Floats:
    """Return how much of a change match frames (n,) show; nothing if it explains nothing."""
    share = (frame - change.first_frame) / max(1.0, change.frame_count - 1.0)
    if change.frame is not None:
        share = (frame >= change.frame).astype(np.float64)
    known = _inside(change, frame) & change.is_explained
    return np.where(known, share, 0.0)


def describe_change(change: CameraChange) -> str:
    """Return a sentence about a change."""
    camera, late = change.camera, change.late_frames
    todo = "worldpose synchronize proposes offsets that change with it"
    when, did = ("later", "lost") if late > 0.0 else ("earlier", "repeated")
    if not change.is_explained:
        what = "its clock changes" if change.kind == "clock" else "it moves"
        near = "" if change.frame is None else f", near frame {change.frame}"
        left = "; its views are left out" if change.is_left_out else ""
        return (
            f"camera {camera}: {what} within the clip{near}, in a way that no knock and no single "
            f"drift explains{left}"
        )
    if change.kind == "clock" and change.frame is not None:
        return (
            f"camera {camera}: its images are {abs(late):.1f} match frames {when} from frame "
            f"{change.frame} on: its recorder {did} images there. {todo}"
        )
    if change.kind == "clock":
        rate = late / max(1.0, change.frame_count - 1.0)
        return (
            f"camera {camera}: its images become {abs(late):.1f} match frames {when} within the "
            f"clip: it takes {abs(rate):.3%} {'fewer' if rate > 0.0 else 'more'} images. {todo}"
        )
    parts = [f"{math.hypot(*change.shift_px):.0f} px"]
    if abs(change.zoom) > 0.003:
        parts.append(f"{change.zoom:+.1%} of zoom")
    if abs(change.roll_rad) > 0.003:
        parts.append(f"{math.degrees(change.roll_rad):+.1f} degrees of roll")
    when = "moves slowly within the clip"
    if change.frame is not None:
        when = f"moves at frame {change.frame}"
    return (
        f"camera {camera} {when}, by {', '.join(parts)}: the people tell how, and its views are "
        "corrected by that. Calibrate it anew for more accuracy, or cut the clip there"
    )


def change_record(change: MeasuredChange, camera: str, frame: Integers) -> CameraChange:
    """Return a change as results store it; match frames (n,) of a clip."""
    x, y, zoom, roll, late = change.amount.tolist()
    found = change.found
    return CameraChange(
        camera=camera,
        kind=found.kind,
        frame=int(frame[found.row]) if found.is_sudden else None,
        first_frame=int(frame[0]),
        frame_count=len(frame),
        shift_px=(x, y),
        zoom=zoom,
        roll_rad=roll,
        late_frames=late,
        std=change.std if np.isfinite(change.std) else None,
        is_explained=change.is_explained,
        is_left_out=not change.is_explained and change.is_left_out and found.kind == "view",
    )
