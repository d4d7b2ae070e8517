"""Faults planted in a sound data set, which its check must find."""

import numpy as np
import xarray as xr
from camera_builders import look_at_camera

from data_contracts.conventions import COCO17
from worldpose.body.keypoints import fold_keypoints
from worldpose.dataset.check import check_clip
from worldpose.dataset.contents import list_clips, read_clip
from worldpose.geometry.rigid import Rigid

FRAMES, PERSONS, FPS = 40, 6, 50.0
Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Takes the world x, y, z to x, -z, y."""


def looking(center, target, focal, distortion=(0.0,) * 5):
    return look_at_camera(center, target, focal, middle=(960.0, 540.0), lens=distortion)


def findings(folder, model, pitch=True):
    clips = list_clips(folder)
    clip = read_clip(folder, clips[0], clips, lambda name: model, None, FPS, pitch)
    return check_clip(clip)


def edit(path, change):
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    change(arrays)
    np.savez(path, **arrays)


def edit_cameras(folder, change):
    for path in sorted((folder / "cameras").glob("*.npz")):
        edit(path, change)


def edit_poses(folder, change):
    edit(folder / "poses" / "A_1.npz", change)


def edit_joints(folder, change):
    edit(folder / "joints.npz", change)


def transpose_rotation(arrays):
    arrays["R"] = arrays["R"].swapaxes(-1, -2)


def center_for_translation(arrays):
    arrays["t"] = -np.einsum("fba,fb->fa", arrays["R"], arrays["t"])


def camera_to_world(arrays):
    center_for_translation(arrays)
    transpose_rotation(arrays)


def turn_poses(arrays, axes, model):
    """Turn whole bodies, as a writer does who knows where the pivot is."""
    pelvis = model.joint_template[0] + arrays["betas"] @ model.joint_directions[0].T
    turn = Rigid(axes, np.zeros(3))
    whole = turn @ Rigid.from_rotvec(arrays["global_orient"].astype(float), np.zeros(3))
    arrays["global_orient"] = whole.rotvec
    pelvis = pelvis[:, None]
    arrays["transl"] = (arrays["transl"] + pelvis) @ axes.T - pelvis


def about_origin(arrays, model):
    pelvis = model.joint_template[0] + arrays["betas"] @ model.joint_directions[0].T
    rotation = Rigid.from_rotvec(arrays["global_orient"].astype(float), np.zeros(3)).rotation
    pelvis = pelvis[:, None]
    arrays["transl"] = arrays["transl"] + pelvis - np.einsum("pfab,pqb->pfa", rotation, pelvis)


def late_poses(arrays):
    for name in ("transl", "global_orient", "body_pose"):
        arrays[name] = np.roll(arrays[name], 1, axis=1)
        arrays[name][:, 0] = np.nan


def zeros_for_missing(arrays):
    for name in ("transl", "global_orient", "body_pose"):
        arrays[name] = np.nan_to_num(arrays[name])


def in_degrees(arrays):
    for name in ("global_orient", "body_pose"):
        arrays[name] = np.degrees(arrays[name])


def scaled(name, size):
    def change(arrays):
        arrays[name] = arrays[name] * size

    return change


def axes_of(name, axes):
    def change(arrays):
        arrays[name] = arrays[name] @ np.asarray(axes, dtype=float).T

    return change


HALF = 8
"""Frames of a clip."""
COVARIANCE = 0.2 * np.eye(10)
"""Of every clip's betas, with a prior of weight 0.5."""


def results(model, poses, camera, clip, first):
    """What a run has of one clip: bodies, their joints, tracks and the broadcast camera."""
    some = poses[:, first : first + HALF]
    joints = fold_keypoints(model, COCO17)(some).swapaxes(0, 1)
    frames = np.arange(first, first + HALF)
    coordinates = {"frame": frames, "person": np.arange(PERSONS)}
    placed = {
        "joints": (("frame", "person", "joint", "axis"), joints),
        "covariance": (("frame", "person", "joint", "axis", "axis_"), np.zeros((*joints.shape, 3))),
        "views": (("frame", "person", "joint"), np.full(joints.shape[:3], 3)),
    }
    fits = {"betas": (("person", "shape"), some.betas[:, 0])}
    fits["betas_covariance"] = (("person", "shape", "shape_"), np.stack([COVARIANCE] * PERSONS))
    for name in ("global_orient", "body_pose", "transl"):
        rows = getattr(some, name).swapaxes(0, 1)
        fits[name] = (("frame", "person", f"{name}_"), rows)
    tracks = [
        {"person": p, "first_frame": 0, "last_frame": HALF - 1, "frames_seen": HALF, "views": 3.0}
        for p in range(PERSONS)
    ]
    rows = camera[first : first + HALF]
    lens = {"focal": rows.focal, "principal_point": rows.principal_point}
    lens |= {"distortion": rows.distortion, "translation": rows.cam_from_world.translation}
    moving = {name: (("frame", f"{name}_"), np.array(values)) for name, values in lens.items()}
    moving["rotation"] = (("frame", "a", "b"), np.array(rows.cam_from_world.rotation))
    moving["image_size"] = (("side",), np.array([1920, 1080]))
    attrs = {"clip_id": clip, "pitch": None}
    still = {key: (dims, values[:1]) for key, (dims, values) in moving.items() if len(dims) > 1}
    rig = xr.Dataset(
        {key: (("camera", *dims[1:]), values) for key, (dims, values) in still.items()}
        | {"image_size": (("camera", "side"), np.array([[1920, 1080]]))},
        coords={"camera": ["north"]},
    )
    return {
        f"tracking/{clip}": xr.Dataset(coords=coordinates, attrs={"tracks": tracks}),
        f"triangulation/{clip}": xr.Dataset(placed, coords=coordinates, attrs={"changes": []}),
        "bundle_adjustment/cameras": rig,
        f"body_fitting/{clip}": xr.Dataset(
            fits | placed, coords=coordinates, attrs={"body_model": model.name}
        ),
        f"broadcast_calibration/{clip}": xr.Dataset(moving, coords={"frame": frames}, attrs=attrs),
    }
