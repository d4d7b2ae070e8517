"""Cameras that change within a clip, and how much: clocks that step or drift, views that move.

The parts of all cameras are fitted together (`change_parts`), taken back in the detections, and
fitted again, until they stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_contracts.arrays import AnyFloats, ClipArray, Flags, Floats, Integers
from data_contracts.keypoints import KeypointDetections
from data_contracts.triangulation import CameraChange
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.triangulation.change_parts import (
    Part,
    expected_step,
    find_sway,
    fit_parts,
    fit_sizes,
    is_settled,
    on_common_clock,
    spreads,
)
from worldpose.triangulation.change_sums import (
    LOOSE,
    WIDTH,
    ChangeSums,
    Kind,
    choose_bins,
    choose_rows,
    half_window,
    sum_joints,
)
from worldpose.triangulation.clocks import shift_in_time, triangulate_views
from worldpose.triangulation.residuals import Rig
from worldpose.triangulation.settings import TriangulationSettings


@dataclass(frozen=True, eq=False)
class MeasuredChange:
    """A change of a camera with its size.

    Attributes:
        camera: index.
        row: row of the first frame after a sudden change; None = over the whole clip.
        amount: (5,) shift along x and y [px], zoom [1], roll [rad] and clock offset [frame] of the
            images after a sudden change, or at the end of the clip.
        std: standard deviation of its size [frame] or [px].
        gain: how many detections it explains, or decrease of the sum of squares [1].
        is_explained: whether all cameras agree with the change corrected.
        is_left_out: whether its views are useless if the change does not explain them.
    """

    camera: int
    kind: Kind
    row: int | None
    amount: Floats
    std: float = np.inf
    gain: float = 0.0
    is_explained: bool = True
    is_left_out: bool = False


def find_changes(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    rows: Integers,
    sums: ChangeSums,
    kinds: Sequence[Kind] = ("clock", "view"),
    start: Sequence[Part] = (),
) -> list[MeasuredChange]:
    """Return the changes of all cameras within a clip.

    Args:
        cameras: batch (cameras,).
        people: detections of the tracked people of a clip.
        fps: rows per second [1/s].
        rows: the rows of the clip that `sums` count, evenly apart.
        sums: equations of the people as triangulated.
        kinds: what may change.
        start: parts that the sums have taken back.
    """
    frames, free = len(rows), None
    parts, after = _fit_clip(cameras, people, fps, rows, sums, kinds, start)
    swaying = find_sway(sums, after, parts) if "view" in kinds else None
    if swaying is not None:
        free, is_left_out = swaying
        parts, after = _fit_clip(cameras, people, fps, rows, sums, kinds, start, free)
    shifting = [part for part in parts if part.shape != "constant"]
    stds = spreads(after, shifting, frames)
    # Where rows are sampled, all frames between two tell at which a view steps.
    whole = [replace(part, row=int(rows[part.row])) for part in parts]
    stride = int(np.diff(rows).max(initial=1))
    if stride > 1:
        frames, fps = len(people.detection_index), fps * stride
        add_up = partial(sum_clip, cameras, people, fps, np.arange(frames), whole)
        whole = place_steps(whole, frames, stride, add_up)
    shifting = [part for part in whole if part.shape != "constant"]
    found = [
        _measure(part, std, cameras[part.camera], frames)
        for part, std in zip(shifting, stds, strict=True)
    ]
    if free is not None:
        unknown = MeasuredChange(free, "view", None, np.zeros(WIDTH), is_explained=False)
        found.append(replace(unknown, is_left_out=is_left_out))
    return found


def _fit_clip(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    rows: Integers,
    sums: ChangeSums,
    kinds: Sequence[Kind],
    start: Sequence[Part],
    free: int | None = None,
) -> tuple[list[Part], ChangeSums]:
    """Return parts as of `find_changes` and sums with them taken back, without a `free` view."""
    parts = [*(Part(c, "constant", 0, (0.0,)) for c in range(sums.cameras)), *start]
    tried = [[part.name for part in parts]]
    for _ in range(12):
        sums = sums if free is None else sums.without_camera(free)
        add_up = partial(sum_clip, cameras, people, fps, rows)
        placed = place_steps(parts, len(rows), round(fps), partial(add_up, parts))
        fitted = on_common_clock(fit_parts(sums, placed, len(rows), kinds))
        names = [part.name for part in fitted]
        # What comes and goes is hardly clear.
        returns = names != tried[-1] and names in tried
        is_done = returns or is_settled(parts, fitted)
        parts = [part for part in fitted if not returns or part.name in tried[-1]]
        tried.append(names)
        if is_done:
            break
        sums = add_up(parts)
    return parts, sums


def _measure(part: Part, std: Floats, camera: Camera, frames: int) -> MeasuredChange:
    """Return a part as a change."""
    row = part.row if part.shape == "step" else None
    amount, size = view_amount(part, camera), float(np.linalg.norm(std[:2]))
    # No recorder's clock runs 2 % fast: such a drift is steps that people hardly show.
    is_usual = row is not None or abs(amount[4]) < 0.02 * frames
    std_px = size if part.kind == "clock" else size * float(camera.focal.mean())
    return MeasuredChange(part.camera, part.kind, row, amount, std_px, is_explained=is_usual)


def view_amount(part: Part, camera: Camera) -> Floats:
    """Return a size as the amount (5,) of a `MeasuredChange`."""
    amount = np.zeros(WIDTH)
    if part.kind == "clock":
        amount[4] = part.size[0]
    else:
        x, y, roll, growth = part.size
        fx, fy = camera.focal
        amount[:4] = fx * y, -fy * x, math.expm1(growth), roll
    return amount


def sum_clip(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    rows: Integers,
    parts: Sequence[Part] = (),
    settings: TriangulationSettings = LOOSE,
    near: slice = slice(None),
    bins: tuple[int, int] | None = None,
) -> ChangeSums:
    """Return the equations of people who are triangulated with parts of the detections taken back.

    Cameras are a batch (cameras,), and `fps` is rows per second [1/s]. `rows` are of the clip, of
    which those `near` count; `bins` are as of `choose_bins`; None = its own choice.
    """
    frames, half = len(rows), half_window(fps)
    length, every = bins or choose_bins(frames * people.detection_index[0].size, fps)
    rig, late = Rig.from_cameras(cameras), np.zeros((len(cameras.focal), frames))
    for part in parts:
        if part.kind == "clock":
            late[part.camera] += part.size[0] * part.share(np.arange(frames), frames)
    reach = math.ceil(np.abs(late).max(initial=0.0)) + half
    first, last, _ = near.indices(frames)
    sums, step = [], length * max(1, 256 // length)
    for start in range(first - first % length, last, step):
        begun, end = max(0, start - reach), min(frames, start + step + reach, last + reach)
        seen = _take_back(people[rows[begun:end]], cameras, parts, begun, frames)
        seen = shift_in_time(seen, late[:, begun:end])
        # Those beyond the chunk have no neighbours in time, or belong to the next.
        inner = slice(max(0, start - half) - begun, min(end, start + step + half) - begun)
        seen, begun = seen[inner], begun + inner.start
        at = choose_rows(len(seen.detection_index), begun, fps, every)
        if not len(at):
            continue
        used = np.unique(at[:, None] + np.array([-half, 0, half]))
        joints = np.full((len(seen.detection_index), seen.detection_index.shape[2], 17, 3), np.nan)
        joints[used] = triangulate_views(rig, seen[used], settings)
        sums.append(sum_joints(cameras, seen, joints, begun, fps, (length, every), settings))
    return ChangeSums.join(sums, cameras, fps)


def place_steps(
    parts: Sequence[Part], frames: int, near: int, add_up: Callable[..., ChangeSums]
) -> list[Part]:
    """Return parts with each step at the row that `near` rows on both sides of it show.

    Along the step's size d, the residuals of a row t have the amplitude a_t with weight h_t: 0
    before the step and 1 from it on, with a constant m. Among rows k, the expected one by
    exp(-sum_t h_t (a_t - [t >= k] - m)^2 / (2 noise)) is chosen. `add_up` is `sum_clip` for people
    with the parts taken back.
    """
    placed = list(parts)
    for number, part in enumerate(parts):
        if part.shape != "step":
            continue
        around = slice(max(0, part.row - near), part.row + near)
        sums = add_up(near=around, bins=(1, 1))
        placed[number] = replace(part, row=expected_step(sums, part, frames))
    return placed


def _take_back(
    people: KeypointDetections, cameras: Camera, parts: Sequence[Part], start: int, frames: int
) -> KeypointDetections:
    """Return some rows of a clip, from a first one on, with parts of views taken back."""
    views = [part for part in parts if part.kind == "view"]
    if not views:
        return people
    keypoints = np.array(people.keypoints, dtype=np.float64)
    rows = np.arange(start, start + len(keypoints))
    for part in views:
        c, share = part.camera, part.share(rows, frames)
        _turn_rows(keypoints[:, c], share, cameras[c], view_amount(part, cameras[c]), back=True)
    return replace(people, keypoints=keypoints)


def refine_change(
    cameras: Camera,
    people: KeypointDetections[ClipArray],
    fps: float,
    camera: int,
    known: CameraChange,
) -> CameraChange:
    """Return a known change of a view with what people show who were tracked through it.

    Cameras are a batch (cameras,), at least three, of which `camera` is the index of the changed
    one. `people` are the tracked ones of a clip, with the known change taken back.
    """
    frame = np.asarray(people.frame, dtype=np.int64)
    parts = [Part(c, "constant", 0, (0.0,)) for c in range(len(cameras.focal))]
    if known.frame is None:
        parts.append(Part(camera, "drift", 0, (0.0,) * 4))
        near = slice(None)
    else:
        row = int(np.searchsorted(frame, known.frame))
        parts.append(Part(camera, "step", row, (0.0,) * 4))
        near = slice(max(0, row - round(6.0 * fps)), row + round(6.0 * fps))
    for _ in range(4):
        taken = parts[-1:]
        sums = sum_clip(cameras, people, fps, np.arange(len(frame)), taken, near=near)
        parts = [*parts[:-1], *fit_sizes(sums, [*parts[:-1], *taken], len(frame))[-1:]]
    std = spreads(sums, parts[-1:], len(frame))[0]
    measured = _measure(parts[-1], std, cameras[camera], len(frame))
    return join_changes(cameras[camera], known, change_record(measured, known.camera, frame))


def move_on(
    pixels: Floats, frame: Integers, camera: Camera, changes: Sequence[CameraChange]
) -> Floats:
    """Return the pixels (frames, ..., 2) of the unchanged camera where the changed one shows them.

    They are missing where nothing explains the camera's views. Later changes were found in views
    that the earlier ones had corrected.
    """
    moved: NDArray[np.float64] = np.array(pixels, dtype=np.float64)
    for change in reversed(changes):
        _turn_rows(moved, _shares(change, frame), camera, _view_amount(change), back=False)
        if change.is_left_out:
            moved[_inside(change, frame)] = np.nan
    return moved


def changed_camera(camera: Camera, frame: int, changes: Sequence[CameraChange]) -> Camera:
    """Return a single camera as its changes turned and zoomed it in a match frame.

    A zoom is one of the focal length, so that pixels differ from `move_on` by a zoomed distortion.
    """
    for change in reversed(changes):
        share = float(_shares(change, np.array([frame]))[0])
        if share > 0.0:
            amount = np.asarray(share * _view_amount(change))
            grown = 1.0 + amount[2]
            turn = _view_motion(camera, amount) / [[grown], [grown], [1.0]]
            pose = Rigid(turn, np.zeros(3)) @ camera.cam_from_world
            camera = replace(camera, cam_from_world=pose, focal=camera.focal * grown)
    return camera


def left_out_frames(changes: Sequence[CameraChange], frame: Integers) -> Flags:
    """Return the match frames (n,) in which the views of a camera with these changes are unused."""
    unused = [_inside(change, frame) for change in changes if change.is_left_out]
    return np.asarray(np.any([np.zeros(len(frame), np.bool_), *unused], axis=0))


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
        _turn_rows(moved[:, c], share, cameras[change.camera], _view_amount(change), back=True)
        if change.is_left_out:
            moved[_inside(change, frame), c] = np.nan
    return moved


def _view_motion(camera: Camera, amount: Floats) -> Floats:
    """Return the matrix (3, 3) of a turn and a zoom that shift the principal point by pixels."""
    x, y, zoom, roll = amount[:4] / [camera.focal[0], camera.focal[1], 1.0, 1.0]
    turn = Rotation.from_rotvec([-y, x, roll]).as_matrix()
    return np.asarray([[1.0 + zoom], [1.0 + zoom], [1.0]] * turn)


def _turn_rows(
    pixels: Floats, share: Floats, camera: Camera, amount: Floats, *, back: bool
) -> None:
    """Move pixels (frames, ..., 2) in place by shares (frames,) of a view's motion, or `back`."""
    unturned = replace(camera, cam_from_world=Rigid.identity())
    for part in np.unique(share[share > 0.0]):
        rows, motion = pixels[share == part], _view_motion(camera, part * amount)
        turn = np.linalg.inv(motion) if back else motion
        plane = camera.normalize(rows.reshape(-1, 2))
        rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ turn.T
        pixels[share == part] = unturned.project(rays).reshape(rows.shape)


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


def join_changes(camera: Camera, first: CameraChange, then: CameraChange) -> CameraChange:
    """Return a change of a view with the little that was found after its correction.

    Turns do not add up: after one of two degrees, a roll of one degree moves the view by another
    0.3 mrad.
    """
    motions = [_view_motion(camera, _view_amount(each)) for each in (first, then)]
    motion = motions[0] @ motions[1]
    motion /= np.linalg.norm(motion[2])
    grown = float(np.linalg.norm(motion[:2], axis=1).mean())
    turn = Rotation.from_matrix(motion / [[grown], [grown], [1.0]]).as_rotvec()
    x, y = (camera.focal * [turn[1], -turn[0]]).tolist()
    found = {"shift_px": (x, y), "zoom": grown - 1.0, "roll_rad": float(turn[2])}
    return then.model_copy(update=found)


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
    if change.kind == "clock" and change.std is None:  # people tell no cause of such an offset
        return (
            f"camera {camera}: near frame {change.frame} its people cease to meet those of the "
            f"others, and then do {abs(late):.0f} match frames {when}: its clock steps or drifts. "
            f"{todo}"
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
    return CameraChange(
        camera=camera,
        kind=change.kind,
        frame=None if change.row is None else int(frame[change.row]),
        first_frame=int(frame[0]),
        frame_count=len(frame),
        shift_px=(x, y),
        zoom=zoom,
        roll_rad=roll,
        late_frames=late,
        std=change.std if np.isfinite(change.std) else None,
        is_explained=change.is_explained,
        is_left_out=not change.is_explained and change.is_left_out and change.kind == "view",
    )
