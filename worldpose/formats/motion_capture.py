"""Exports: TRC markers, BVH and OpenSim motion, and COCO keypoints in the images of a camera."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data_contracts.arrays import Flags, Floats, find_runs
from data_contracts.conventions import COCO17, COCO17_BONES
from worldpose.body.keypoints import SKELETONS
from worldpose.body.model import BodyModel, BodyParameters
from worldpose.errors import InputError
from worldpose.formats.files import whole_file
from worldpose.formats.joints_file import JointTracks
from worldpose.formats.tables import write_rows
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid, shortest_rotation

PIXEL_DECIMALS: Final = 2
"""Decimals of all pixel values: a hundredth of a pixel is far below any detector's error."""


def coco_dataset(
    camera_id: str,
    camera: Camera,
    tracks: JointTracks,
    observed: NDArray[np.bool_],
    *,
    number: NDArray[np.int64] | None = None,
    move: Callable[[Floats], Floats] | None = None,
) -> dict[str, Any]:
    """Return the people of one camera as a COCO keypoints data set.

    One image per frame with a camera: `id` is the camera's own frame number, `file_name` is
    <camera>/<frame with six digits>. One annotation per person with at least one joint in the
    image: `keypoints` are the reprojected 3D joints with v = 2 if they are `observed`, v = 1 if
    not, and 0, 0, 0 if there is no joint or it is outside the image. `bbox` and `area` are those of
    the keypoints; `track_id` is the person, and `identity_certainty` the probability of that, where
    it is known.

    Args:
        camera_id: prefix of the image names.
        camera: a single camera, or (frames,) of a moving one; NaN where a frame has none.
        tracks: frames are match frames.
        observed: (frames, persons, 17), the camera's observation of the joint was an inlier, or no
            nearer person hides it in the moving camera.
        number: (frames,) the camera's own frame at each frame, not falling; of frames that it shows
            twice the first one counts. None = the match frames.
        move: returns pixels (frames, persons, 17, 2) where the camera shows them, if its view
            changes within the clip.
    """
    width, height = (int(n) for n in camera.image_size.reshape(-1, 2)[0])
    frames, persons = tracks.joints.shape[:2]
    pixels = camera.project(tracks.joints.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)
    pixels = np.round(pixels if move is None else move(pixels), PIXEL_DECIMALS)
    within = (pixels >= -0.5) & (pixels <= np.array([width, height]) - 0.5)
    own_frames = tracks.frames if number is None else number
    is_shown = _is_shown(own_frames, camera)
    visible = np.all(within, axis=-1) * np.where(observed, 2, 1) * is_shown[:, None, None]
    annotations = [
        {
            "id": number,
            "image_id": int(own_frames[frame]),
            "category_id": 1,
            "track_id": int(tracks.person_ids[person]),
            **_certainty(tracks, frame, person),
            "iscrowd": 0,
            **_labels(pixels[frame, person], visible[frame, person]),
        }
        for number, (frame, person) in enumerate(np.argwhere(visible.any(-1)), start=1)
    ]
    return {
        "info": {
            "description": f"3D joints reprojected into camera {camera_id}; (0, 0) is the centre "
            "of the top-left pixel; v = 2: agrees with this static camera's observation, or is not "
            "hidden in the moving one, v = 1: other joints, v = 0: no joint in the picture",
            "version": "1.0",
        },
        "licenses": [],
        "images": [
            {"id": frame, "file_name": f"{camera_id}/{frame:06d}", "width": width, "height": height}
            for frame in own_frames[is_shown].tolist()
        ],
        "annotations": annotations,
        "categories": [
            {
                "id": 1,
                "name": "person",
                "supercategory": "person",
                "keypoints": list(COCO17),
                "skeleton": [[a + 1, b + 1] for a, b in COCO17_BONES],
            }
        ],
    }


def _is_shown(number: NDArray[np.int64], camera: Camera) -> Flags:
    """Return the frames (frames,) whose camera is known, and shows an image for the first time."""
    first = (np.diff(number, prepend=-np.inf) > 0) & (number >= 0)
    return np.asarray(first & np.isfinite(camera.center).all(axis=-1))


def _certainty(tracks: JointTracks, frame: int, person: int) -> dict[str, float]:
    """Return the probability of a person's identity in a frame, where it is known."""
    stated = tracks.identity_certainty
    if stated is None or np.isnan(stated[frame, person]):
        return {}
    return {"identity_certainty": round(float(stated[frame, person]), 4)}


def alphapose_results(
    pixels: Floats,
    hidden: Flags,
    person_ids: NDArray[np.integer],
    camera: Camera,
    number: NDArray[np.int64],
) -> list[dict[str, Any]]:
    """Return people in the images of a camera as results of AlphaPose in 26 points of Halpe.

    Tools that lift 2D poses, such as MotionBERT, read this list: one entry per person and image, by
    image, with the person as `idx`. A point, (frames, persons, 26, 2) [px] or NaN, has confidence 1
    if nothing hides it, 0.5 if `hidden` (frames, persons, 26) by a nearer person, and 0 outside the
    image. Camera and number are as in `coco_dataset`.
    """
    size = camera.image_size.reshape(-1, 2)[0]
    within = np.all((pixels >= -0.5) & (pixels <= size - 0.5), axis=-1)
    within &= _is_shown(number, camera)[:, None, None]
    sure = np.where(within, np.where(hidden, 0.5, 1.0), 0.0)
    entries = []
    for frame, person in np.argwhere(within.any(-1)).tolist():
        here = within[frame, person]
        low, high = (f(pixels[frame, person, here], axis=0) for f in (np.min, np.max))
        points = np.column_stack([pixels[frame, person], sure[frame, person]])
        points = np.round(np.where(here[:, None], points, 0.0), PIXEL_DECIMALS)
        entries.append(
            {
                "image_id": f"{number[frame]}.jpg",
                "category_id": 1,
                "keypoints": points.ravel().tolist(),
                "score": round(float(sure[frame, person].mean()), 4),
                "box": np.round([*low, *(high - low)], PIXEL_DECIMALS).tolist(),
                "idx": int(person_ids[person]),
            }
        )
    return entries


def write_json(path: Path, content: Mapping[str, Any] | list[dict[str, Any]]) -> None:
    """Write labels as JSON, whole or not at all."""
    with whole_file(path) as draft:
        draft.write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")


def _labels(pixels: NDArray[np.float64], visible: NDArray[np.int64]) -> dict[str, Any]:
    """Return keypoints and box of one person: (17, 2) [px] and v (17,), at least one above 0."""
    seen = visible > 0
    low, high = pixels[seen].min(axis=0), pixels[seen].max(axis=0)
    width, height = np.round(high - low, PIXEL_DECIMALS).tolist()
    triples = np.column_stack([np.where(seen[:, None], pixels, 0.0), visible])
    return {
        "keypoints": [value for x, y, v in triples.tolist() for value in (x, y, int(v))],
        "num_keypoints": int(seen.sum()),
        "bbox": [*low.tolist(), width, height],
        "area": round(width * height, PIXEL_DECIMALS),
    }


Y_UP: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation of world points to the axes of OpenSim and of animation tools: x stays, y is up."""


def write_markers(path: Path, tracks: JointTracks, person: int, fps: float) -> None:
    """Write the joints of one person, an index in `tracks`, as a TRC file, whole or not at all.

    Markers are the 17 joints, and heels and toes where the clip has them. Rows cover every frame
    from the person's first to last joint; a missing joint has empty cells. `Frame#` is the match
    frame plus one, as such files count from one, and `Time` is that of the match frame [s].
    Coordinates are y up, in millimetres.
    """
    trc_decimals = 3  # decimals of all coordinates: a micrometre
    first, markers = _rows(tracks, person)
    names = tracks.markers.points
    count = len(names)
    numbers = np.arange(first, first + len(markers))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"
        "\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{fps:g}\t{fps:g}\t{len(markers)}\t{count}\tmm\t{fps:g}\t1\t{len(markers)}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, count + 1)),
        "",
    ]
    values = markers.reshape(len(markers), 3 * count)
    form = f"%.{trc_decimals}f"
    write_rows(path, head, [(numbers + 1, "%d"), (numbers / fps, "%.6f"), (values, form)])


def _rows(tracks: JointTracks, person: int) -> tuple[int, NDArray[np.float64]]:
    """Return the first match frame, and markers (frames, points, 3) [mm, y up] from there."""
    millimetres = 1000.0  # millimetres in a metre: TRC files are in millimetres, and state it
    joints = tracks.markers.joints
    seen = np.flatnonzero(np.isfinite(tracks.joints[:, person]).any((-1, -2)))
    if not len(seen):
        return 0, np.empty((0, joints.shape[2], 3))
    numbers = tracks.frames[seen]
    first = int(numbers[0])
    markers = np.full((int(numbers[-1]) - first + 1, joints.shape[2], 3), np.nan)
    markers[numbers - first] = joints[seen, person] @ Y_UP.T * millimetres
    return first, markers


BVH_DECIMALS: Final = 6
"""Decimals of all numbers: a hundredth of a micrometre, and angles that move a hand by as much."""


def write_motion(path: Path, model: BodyModel, poses: BodyParameters, fps: float) -> None:
    """Write one person's poses (frames,), complete, as a BVH file, whole or not at all.

    The skeleton has the model's 24 joints in T-pose, with the bone lengths of the first frame's
    betas; leaf joints end in half of their bone, only for display. The root has position and
    rotation, every other joint its rotation relative to its parent; angles are in degrees and apply
    in the order z, x, y of the file's axes. Lengths are centimetres and y is up. InputError for no
    frames.
    """
    centimetres = 100.0  # in a metre: animation tools take numbers of BVH for them
    angles = np.concatenate([poses.global_orient, poses.body_pose], axis=-1)
    if not len(angles) or not np.isfinite([angles.sum(), poses.transl.sum()]).all():
        found = f"{len(angles)} frames, some without" if len(angles) else "no frames"
        todo = "Write a file for each uninterrupted stretch."
        raise InputError(str(path), "frames that all have a body", found, todo)
    betas = poses.betas[0]
    rest = model.joint_template + model.joint_directions @ betas
    turns = Rigid.from_rotvec(angles.reshape(len(angles), -1, 3), np.zeros(3)).rotation.copy()
    turns[:, 0] = Y_UP @ turns[:, 0]
    roots = (rest[0] + poses.transl) @ Y_UP.T * centimetres
    channels = np.unwrap(np.degrees(zxy_angles(turns)), axis=0, period=360.0)
    # Depth first, the joint order of the file.
    order = list(_depth_first(model.parents, 0))
    rows = np.concatenate([roots, channels[:, order].reshape(len(roots), -1)], axis=1)
    head = ["HIERARCHY", *_joint(rest * centimetres, model.parents, 0, "")]
    head += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1.0 / fps:.9f}"]
    write_rows(path, head, [(rows, f"%.{BVH_DECIMALS}f")], " ")


def stretches(poses: BodyParameters) -> list[slice]:
    """Return the uninterrupted intervals of frames in which a person (frames,) has a body."""
    parts = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
    there = np.all([np.isfinite(part).all(-1) for part in parts], axis=0)
    return find_runs(np.asarray(there))


def _depth_first(parents: NDArray[np.int64], joint: int) -> Iterator[int]:
    yield joint
    for child in np.flatnonzero(parents == joint):
        yield from _depth_first(parents, int(child))


def _joint(rest: Floats, parents: NDArray[np.int64], joint: int, indent: str) -> list[str]:
    """Return the lines of a joint and its descendants; `rest` (24, 3) is in the file's unit."""
    parent, children = int(parents[joint]), np.flatnonzero(parents == joint)
    offset = rest[joint] - rest[parent] if parent >= 0 else np.zeros(3)
    places = "" if parent >= 0 else "Xposition Yposition Zposition "
    inner = indent + "  "
    lines = [
        f"{indent}{'JOINT' if parent >= 0 else 'ROOT'} {SKELETONS['smpl24'][joint]}",
        f"{indent}{{",
        f"{inner}OFFSET {_numbers(offset)}",
        f"{inner}CHANNELS {6 if places else 3} {places}Zrotation Xrotation Yrotation",
    ]
    for child in children:
        lines += _joint(rest, parents, int(child), inner)
    if not len(children):
        lines += [f"{inner}End Site", f"{inner}{{"]
        lines += [f"{inner}  OFFSET {_numbers(0.5 * offset)}", f"{inner}}}"]
    return [*lines, f"{indent}}}"]


def _numbers(vector: Floats) -> str:
    return " ".join(f"{value:.{BVH_DECIMALS}f}" for value in vector)


def zxy_angles(rotation: Floats) -> Floats:
    """Return angles (..., 3) [rad] with rotation = Rz(first) Rx(second) Ry(third)."""
    cosine = np.hypot(rotation[..., 2, 0], rotation[..., 2, 2])
    # Cosine of the middle angle below which the outer two have the same axis (gimbal lock) [1].
    locked_cosine = 1e-7
    locked = cosine < locked_cosine
    about_z = np.where(
        locked,
        np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]),
        np.arctan2(-rotation[..., 0, 1], rotation[..., 1, 1]),
    )
    about_y = np.where(locked, 0.0, np.arctan2(-rotation[..., 2, 0], rotation[..., 2, 2]))
    return np.stack([about_z, np.arctan2(rotation[..., 2, 1], cosine), about_y], axis=-1)


MIRROR: Final = np.diag([1.0, 1.0, -1.0])
"""Reflection in the body's sagittal plane: a left limb's angles are those of its mirror image."""
OPENSIM_COORDINATES: Final = (
    *("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz"),
    *("hip_flexion_r", "hip_adduction_r", "hip_rotation_r", "knee_angle_r", "ankle_angle_r"),
    *("hip_flexion_l", "hip_adduction_l", "hip_rotation_l", "knee_angle_l", "ankle_angle_l"),
    *("lumbar_extension", "lumbar_bending", "lumbar_rotation"),
    *("arm_flex_r", "arm_add_r", "arm_rot_r", "elbow_flex_r"),
    *("arm_flex_l", "arm_add_l", "arm_rot_l", "elbow_flex_l"),
)
"""Columns after `time`."""
OPENSIM_CONVENTION: Final = (
    "OpenSim, coordinates of Rajagopal et al. (2016): body axes x forward, y up, z right; order of "
    "rotations z, x, y; ground y up; zero: body model's T-pose, arms and bones of legs hang down"
)
_JOINT: Final = {name: index for index, name in enumerate(SKELETONS["smpl24"])}


def opensim_coordinates(model: BodyModel, poses: BodyParameters) -> Floats:
    """Return `OPENSIM_COORDINATES` (frames, 27) [deg, m] for one person's poses (frames,).

    An angle is the one that the rotation of the child relative to its parent has in Rajagopal's
    order, z then x then y. The trunk is the pelvis's rotation to `spine3`, the arm the rotation
    from there to the upper arm, collar included. The axes of thighs and shanks are turned so that
    their bones, which lean by some degrees in the T-pose, hang along -y at zero. Knees, ankles and
    elbows have one coordinate: their rotation about z, of the same order; the rest of it is left
    out. The pelvis's place is such that the middle of the hips of the unscaled model is that of the
    body.
    """
    # Rotation from the axes of the body model in T-pose (x left, y up, z forward) to those of
    # OpenSim's bodies (x forward, y up, z right).
    opensim_axes = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    rest = (model.joint_template + model.joint_directions @ poses.betas[0]) @ opensim_axes.T
    turns = model.articulate(poses).local_rotations
    relative = opensim_axes @ turns @ opensim_axes.T
    pelvis = Y_UP @ Rigid.from_rotvec(poses.global_orient, np.zeros(3)).rotation @ opensim_axes.T

    def turn(*names: str) -> Floats:
        """Return the rotation of a chain of joints, from the first's parent to the last."""
        whole = np.broadcast_to(np.eye(3), pelvis.shape)
        for name in names:
            whole = whole @ relative[:, _JOINT[name]]
        return whole

    hips = model.joints(poses)[:, [_JOINT["left_hip"], _JOINT["right_hip"]]].mean(axis=1)
    mid_hip_m = np.array([-0.056276, -0.07849, 0.0])  # from the unscaled pelvis's origin
    place = hips @ Y_UP.T - pelvis @ mid_hip_m
    columns = {}
    # Rotation of the right arm from hanging, OpenSim's zero, to the T-pose: -90 degrees about x.
    lowered = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    for side, mirror in (("right", np.eye(3)), ("left", MIRROR)):
        arm = mirror @ turn(f"{side}_collar", f"{side}_shoulder") @ mirror @ lowered
        elbow = lowered.T @ mirror @ turn(f"{side}_elbow") @ mirror @ lowered
        hip, knee, ankle = (
            mirror @ turn(f"{side}_{name}") @ mirror for name in ("hip", "knee", "ankle")
        )
        places = [rest[_JOINT[f"{side}_{name}"]] @ mirror for name in ("hip", "knee", "ankle")]
        bones = [(b - a) / np.linalg.norm(b - a) for a, b in pairwise(places)]
        thigh, shank = shortest_rotation(np.array([0.0, -1.0, 0.0]), np.array(bones))
        hip, knee, ankle = hip @ thigh, thigh.T @ knee @ shank, shank.T @ ankle
        # Knees bend backwards: about -z, as the model counts flexion.
        leg = [_angles(hip), -_angles(knee)[:, :1], _angles(ankle)[:, :1]]
        columns[side] = (leg, [_angles(arm), _angles(elbow)[:, :1]])
    trunk = _angles(turn("spine1", "spine2", "spine3"))
    parts = [_angles(pelvis), place, *columns["right"][0], *columns["left"][0], trunk]
    return np.concatenate([*parts, *columns["right"][1], *columns["left"][1]], axis=-1)


def write_opensim_motion(
    path: Path, coordinates: Floats, times: Floats, notes: Mapping[str, str]
) -> None:
    """Write coordinates (frames, 27) [deg, m] of `opensim_coordinates` as a .mot file.

    They are at times (frames,) [s], and the header has `notes`, one line each. InputError for no
    frames, or a missing value.
    """
    mot_decimals = 5  # decimals of degrees, metres and seconds
    if not len(coordinates) or not np.isfinite(coordinates).all():
        found = f"{len(coordinates)} frames, some without" if len(coordinates) else "no frames"
        todo = "Write a file for each uninterrupted interval."
        raise InputError(str(path), "frames that all have a body", found, todo)
    rows = np.column_stack([times, coordinates])
    head = [
        "Coordinates",
        "version=1",
        f"nRows={len(rows)}",
        f"nColumns={rows.shape[1]}",
        "inDegrees=yes",
        *(f"{name}={' '.join(text.split())}" for name, text in notes.items()),
        "endheader",
        "\t".join(["time", *OPENSIM_COORDINATES]),
    ]
    write_rows(path, head, [(rows, f"%.{mot_decimals}f")])


def _angles(rotation: Floats) -> Floats:
    """Return angles (frames, 3) [deg] about z, x and y, without jumps from frame to frame."""
    angles: Floats = np.unwrap(np.degrees(zxy_angles(rotation)), axis=0, period=360.0)
    return angles
