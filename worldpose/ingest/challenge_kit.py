"""Import of a pose challenge's inputs: one match of a broadcast camera for each sequence."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from data_contracts.arrays import Flags, Floats
from data_contracts.conventions import COCO17
from data_contracts.keypoints import KeypointDetections
from data_contracts.match import CameraSpec, ClipSpec, MatchSpec
from data_contracts.pitch import PitchSpec
from worldpose.body.keypoints import BODY25, CHALLENGE15
from worldpose.errors import InputError
from worldpose.formats.archives import write_archive
from worldpose.formats.camera_data import COLUMNS, CameraData, write_camera_data
from worldpose.formats.challenge import read_kit_array
from worldpose.formats.files import require_file
from worldpose.formats.release_cameras import read_kit_camera
from worldpose.geometry.cameras import Camera
from worldpose.geometry.pan_tilt import camera_angles
from worldpose.ingest.match_folder import camera_data_file, given_boxes_file
from worldpose.ingest.validation import validate_record
from worldpose.ingest.writing import write_match
from worldpose.pitch.template import PitchTemplate
from worldpose.video.folder import index_video
from worldpose.video.names import is_video
from worldpose.video.pictures import FrameIndex

Lift = Callable[[Floats, float], tuple[Floats, Floats]]
"""Returns the rotations of the pelvis (frames, 3) and of the other joints (frames, 69) [rad] of a
body with COCO-17 joints (frames, 17, 3) [m] at a frame rate [1/s]."""


@dataclass(frozen=True, eq=False)
class KitSequence:
    """Inputs of one sequence.

    Attributes:
        camera: (frames,); its pose is NaN where the file has none.
        boxes: (frames, persons, 4) x0, y0, x1, y1 [px]; NaN when absent.
        skel_2d: (frames, persons, 17, 2) [px], COCO-17; NaN where unknown. None without a file.
        skel_3d: (frames, persons, 17, 3) [m], camera axes. None without a file.
        video: the video, or the folder of numbered images.
    """

    name: str
    camera: Camera
    boxes: Floats
    skel_2d: Floats | None
    skel_3d: Floats | None
    video: Path
    index: FrameIndex


def import_challenge(
    kit: Path, out: Path, lift: Lift, fps: float | None = None
) -> dict[str, tuple[MatchSpec, list[str]]]:
    """Write a match folder `out/<sequence>` for each sequence; return match.yaml and notes of each.

    The kit has `cameras/<sequence>.npz` (K and k of every frame, R and t of the first or of every
    one), `boxes/<sequence>.npy`, `videos/<sequence>.mp4` or `images/<sequence>/`,
    `pitch_points.txt`, and possibly `skel_2d/` and `skel_3d/`. Boxes and skeletons have one row per
    person. The boxes become tracks with the row as id, 2D skeletons become keypoints, and 3D
    skeletons become monocular poses, after `lift` turns each into rotations of the body's joints.

    `fps` [1/s] None is that of the videos; images have none. InputError if a file is missing,
    invalid, or contradicts another one; nothing is written then.
    """
    pitch = _read_pitch(kit / "pitch_points.txt")
    cameras = sorted((kit / "cameras").glob("[!.]*.npz"))
    if not cameras:
        raise _refuse(str(kit), "cameras/<sequence>.npz", "no such file")
    for boxes in sorted((kit / "boxes").glob("[!.]*.npy")):
        if (expected := kit / "cameras" / f"{boxes.stem}.npz") not in cameras:
            raise _refuse(str(kit), f"{expected}, as there is {boxes.name}", "no such file")
    read = [_read_sequence(kit, file) for file in cameras]
    rates = {each.name: each.index.fps if fps is None else fps for each in read}
    for each in read:
        if not np.isfinite(rates[each.name]):
            raise _refuse(str(each.video), "frames per second", "images, which tell none", "fps")
        if (out / each.name).exists():
            raise _refuse(str(out / each.name), "no such folder yet", "one", "other")
    return {each.name: _write_sequence(each, rates[each.name], pitch, out, lift) for each in read}


def _read_sequence(kit: Path, file: Path) -> KitSequence:
    """Return a sequence whose files agree in the number of frames and persons."""
    name = file.stem
    boxes_file = kit / "boxes" / f"{name}.npy"
    require_file(boxes_file)
    boxes = read_kit_array(boxes_file, "boxes")
    frames, known = len(boxes), np.isfinite(boxes)
    with np.errstate(invalid="ignore"):
        wrong = known.any(-1) & ~(known.all(-1) & (boxes[..., :2] < boxes[..., 2:]).all(-1))
    if wrong.any():
        frame, person = np.argwhere(wrong)[0].tolist()
        where = f"{boxes_file}: frame {frame}, person {person}"
        raise _refuse(where, "x0 < x1 and y0 < y1, or NaN", f"{boxes[frame, person].tolist()}")
    empty = np.flatnonzero(~known.any((0, 2)))
    if len(empty):
        where = f"{boxes_file}: person {empty[0]}"
        raise _refuse(where, "a box in some frame", "none", "row")
    skeletons = {}
    for kind in ("skel_2d", "skel_3d"):
        path = kit / kind / f"{name}.npy"
        skeletons[kind] = (
            _read_skeleton(path, kind, np.asarray(known.all(-1))) if path.exists() else None
        )
    videos = sorted(path for path in (kit / "videos").glob(f"{name}.*") if is_video(path))
    if len(videos) > 1:
        found = ", ".join(path.name for path in videos)
        raise _refuse(str(kit / "videos"), f"one video of {name}", found)
    images = kit / "images" / name
    if not videos and not images.is_dir():
        raise _refuse(str(kit), f"videos/{name}.mp4 or images/{name}/", "neither")
    video = videos[0] if videos else images
    index = index_video(video)
    if len(index) != frames:
        raise _refuse(str(video), f"{frames} frames, as {boxes_file.name} has", f"{len(index)}")
    camera = read_kit_camera(file, index.size)
    if len(camera.focal) != frames:
        found = f"{len(camera.focal)}"
        raise _refuse(f"{file}: K", f"{frames} frames, as {boxes_file.name} has", found)
    return KitSequence(
        name, camera, boxes, skeletons["skel_2d"], skeletons["skel_3d"], video, index
    )


def _read_skeleton(path: Path, kind: str, known: Flags) -> Floats:
    """Return COCO-17 points (frames, persons, 17, axes) of people with boxes (frames, persons)."""
    given = read_kit_array(path, kind)
    orders = {len(BODY25): BODY25, len(CHALLENGE15): CHALLENGE15}
    if given.shape[:2] != known.shape or given.shape[2] not in orders:
        expected = f"{known.shape} frames and persons, as the boxes have, of 25 or 15 points"
        raise _refuse(str(path), expected, f"{given.shape}")
    names = orders[given.shape[2]]
    points = np.full((*known.shape, len(COCO17), given.shape[3]), np.nan)
    for place, name in enumerate(COCO17):
        if name in names:
            points[:, :, place] = given[:, :, names.index(name)]
    points[~(known[..., None] & np.isfinite(points).all(-1))] = np.nan
    return points


def _read_pitch(path: Path) -> PitchSpec:
    """Return the pitch whose markings are at the points (n, 3) [m] of a text."""
    require_file(path, 1 << 24)
    try:
        points = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise _refuse(str(path), "lines of x y z [m]", f"{error}") from error
    if points.shape[1] != 3 or not np.isfinite(points).all():
        raise _refuse(str(path), "lines of three finite numbers x y z [m]", f"{points.shape}")
    length, width = (2.0 * np.abs(points[:, :2]).max(axis=0)).tolist()
    flat = {"length": length, "width": width, "crown": 0.0, "end_fall": 0.0}
    place = str(path)

    def template(**changes: float) -> PitchTemplate:
        return PitchTemplate.from_spec(validate_record(PitchSpec, flat | changes, place))

    lines = template().sample_lines(0.1).points_world[:, :2]
    off = KDTree(lines).query(points[:, :2])[0]
    # Points may be measured to edges of the paint; more than a few off the lines are another game.
    far = off > 0.3
    if far.mean() > 0.05:
        found = f"{far.sum()} of {len(points)} points off them, the first at {points[far][0]}"
        raise _refuse(place, f"points on the markings of {length:.1f} x {width:.1f} m", found)
    x, y = points[:, 0], points[:, 1]
    shapes = [template(crown=1.0).height(x, y), template(end_fall=1.0).height(x, y)]
    level = np.stack([*shapes, np.ones(len(points))], axis=1)
    crown, fall, base = np.linalg.lstsq(level, points[:, 2], rcond=None)[0]
    residual = float(np.abs(level @ [crown, fall, base] - points[:, 2]).max())
    if residual > 0.05 or abs(base - min(0.0, -fall)) > 0.5:
        raise _refuse(place, "heights of a crowned surface", f"{residual:.2f} m from one")
    surface = {"crown": max(0.0, float(np.round(crown, 4))), "end_fall": float(np.round(fall, 4))}
    return validate_record(PitchSpec, flat | surface, place)


def _write_sequence(
    sequence: KitSequence, fps: float, pitch: PitchSpec, out: Path, lift: Lift
) -> tuple[MatchSpec, list[str]]:
    """Write the match folder of a sequence; return match.yaml, and sentences about it."""
    name, (wide, high) = sequence.name, sequence.index.size
    frames, persons = sequence.boxes.shape[:2]
    file = f"broadcast/{sequence.video.name}"
    # Name of the camera of an imported match.
    camera_name = "broadcast"
    camera = CameraSpec(id=camera_name, kind="broadcast", width=wide, height=high, video=file)
    clip = ClipSpec(id=name, frame_count=frames, broadcast=camera_name)
    spec = MatchSpec(match_id=name, fps=fps, cameras=(camera,), clips=(clip,))
    posed = np.isfinite(sequence.camera.cam_from_world.rotation).all((-1, -2)).sum()
    notes = [f"{name}: {persons} people, camera poses of {posed} of {frames} frames"]
    seen = {} if sequence.skel_2d is None else {name: _detections(sequence, sequence.skel_2d)}
    if sequence.skel_2d is None:
        notes.append(f"{name}: no skel_2d; the run estimates keypoints in the given boxes")
    if sequence.skel_3d is None:
        notes.append(f"{name}: no skel_3d; bodies need estimates/{name}.npz of another method")

    def add(folder: Path) -> None:
        copy = shutil.copytree if sequence.video.is_dir() else shutil.copyfile
        (folder / "broadcast").mkdir()
        copy(sequence.video, folder / file)
        boxes = folder / given_boxes_file(name)
        boxes.parent.mkdir()
        np.save(boxes, sequence.boxes, allow_pickle=False)
        (folder / "estimates").mkdir()
        write_camera_data(folder / camera_data_file(name), _camera_table(sequence.camera))
        if sequence.skel_3d is not None:
            estimates = folder / "estimates" / f"{name}.npz"
            write_archive(estimates, _monocular_arrays(sequence, sequence.skel_3d, fps, lift))

    write_match(out / name, spec, calibrations={}, observations=seen, pitch=pitch, further=add)
    return spec, notes


def _detections(sequence: KitSequence, keypoints: Floats) -> KeypointDetections:
    """Return the 2D skeletons as detections in the order of the boxes."""
    there = np.asarray(np.isfinite(sequence.boxes).all(-1))
    known = np.isfinite(keypoints).all(-1)
    return KeypointDetections(
        frame=np.arange(len(there), dtype=np.int64),
        keypoints=keypoints.astype(np.float32),
        # The kit states no confidence.
        confidence=np.where(known, 1.0, np.nan).astype(np.float32),
        boxes=sequence.boxes.astype(np.float32),
        score=np.where(there, 1.0, np.nan).astype(np.float32),
    )


def _camera_table(camera: Camera) -> CameraData:
    """Return the camera as camera data; angles and center are NaN where its pose is."""
    values = np.full((len(camera.focal), len(COLUMNS)), np.nan)
    values[:, :3] = np.stack(camera_angles(camera), axis=1)
    values[:, 3:6] = camera.center
    values[:, 6], values[:, 7:9] = camera.focal.mean(axis=-1), camera.distortion[:, :2]
    values[:, 10:12] = camera.principal_point
    # The camera turns about a fixed center, which the pose of any frame tells.
    posed = np.isfinite(values[:, 3])
    values[~posed, 3:6] = np.median(values[posed, 3:6], axis=0)
    return CameraData(np.arange(len(values)), values)


def _monocular_arrays(
    sequence: KitSequence, skeletons: Floats, fps: float, lift: Lift
) -> dict[str, Floats]:
    """Return the 3D skeletons as rotations of the body's joints, a row for each."""
    camera, rows = sequence.camera, []
    middle = 0.5 * (sequence.boxes[..., :2] + sequence.boxes[..., 2:])
    for person in range(skeletons.shape[1]):
        own = np.flatnonzero(np.isfinite(skeletons[:, person, (5, 6, 11, 12)]).all((-1, -2)))
        if not len(own):
            continue
        orient, pose = lift(skeletons[:, person], fps)
        off = middle[own, person] - 0.5 * (np.array(sequence.index.size) - 1.0)
        focal = camera.focal[own].mean(axis=-1, keepdims=True)
        place = np.concatenate([off / focal, np.ones_like(focal)], axis=1)
        rows.append((own, orient[own], pose[own], place, focal[:, 0]))
    if not rows:
        where = f"skel_3d of {sequence.name}"
        raise _refuse(where, "skeletons with shoulders and hips", "none")
    frame, orient, pose, place, focal = (np.concatenate(part) for part in zip(*rows, strict=True))
    return {
        "frame": frame,
        "global_orient": orient,
        "body_pose": pose,
        "transl": place,
        "focal_length": focal,
        "img_size": np.tile(np.array(sequence.index.size, dtype=np.float64), (len(frame), 1)),
    }


_TODO: Final = {
    "kit": "Lay the files out as the challenge's kit does, and import again.",
    "fps": "Add for example --fps 50.",
    "other": "Choose another --out, or remove the folder.",
    "row": "Remove the row here and in the skeletons; no pose can be scored there.",
}


def _refuse(where: str, expected: str, found: str, todo: str = "kit") -> InputError:
    return InputError(where, expected=expected, found=found, todo=_TODO[todo])
