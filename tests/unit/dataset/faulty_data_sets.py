"""Faults planted in a sound data set, which its check must find."""

import numpy as np
from camera_builders import look_at_camera

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
    """Change the arrays of an npz file in place."""
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
