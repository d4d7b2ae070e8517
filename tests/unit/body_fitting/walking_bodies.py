"""Open bodies that walk, as truth for fits."""

import numpy as np
from camera_builders import plain_camera

from data_contracts.conventions import COCO17
from worldpose.body.body_file import load_open_body
from worldpose.body.keypoints import fold_keypoints
from worldpose.body.model import BODY_POSE, BodyParameters
from worldpose.body_fitting.pose_space import SPREAD, load_pose_prior
from worldpose.geometry.rigid import Rigid

MODEL = load_open_body()
KEYPOINTS = fold_keypoints(MODEL, COCO17)


def walker(frames, rng, *, fps=50.0, upside_down=False):
    """A body that swings arms and legs on its way along x."""
    time = np.arange(frames) / fps
    angles = np.tile(load_pose_prior().mean, (frames, 1))
    swing = np.sin(2.0 * np.pi * 1.2 * time + rng.uniform(0.0, 6.0))
    angles[:, 6] += 0.4 * swing
    angles[:, 9] -= 0.4 * swing
    angles[:, 19] += 0.4 * swing
    angles[:, 22] -= 0.4 * swing
    angles[:, 12] += 0.3 * swing
    angles[:, 15] -= 0.3 * swing
    # Upright, or on the head, and looking along x.
    turn = np.array([np.pi / 2, 0.0, 0.0]) if not upside_down else np.array([-1.4, 0.0, 0.2])
    return BodyParameters(
        betas=np.r_[rng.normal(0.0, 0.7, 3), np.zeros(7)],
        global_orient=np.broadcast_to(turn, (frames, 3)),
        body_pose=(angles @ SPREAD.T).reshape(frames, BODY_POSE),
        transl=np.stack([1.5 * time, 0.0 * time, np.full(frames, 0.95)], axis=-1),
    )


def seen(parameters, noise, rng):
    """Joints (frames, 1, 17, 3) with noise [m], of all joints or (17,), and their covariance."""
    joints = KEYPOINTS(parameters)[:, None]
    std = np.broadcast_to(noise, 17)[:, None]
    joints = joints + std * rng.standard_normal(joints.shape)
    spread = np.maximum(std, 0.005)[..., None] ** 2 * np.eye(3)
    return joints, np.broadcast_to(spread, (*joints.shape, 3)).copy()


def panning_camera(frames, pan=(-0.12, 0.12), center=(0.0, -70.0, 15.0), focal=4000.0, aim=0.0):
    """A camera in a stand that pans by angles [rad] past a point above the origin [m]."""
    pan, center = np.linspace(*pan, frames), np.array(center)
    down = np.arctan2(center[2] - aim, -center[1])
    x = np.stack([np.cos(pan), np.sin(pan), 0.0 * pan], axis=-1)
    ahead = np.stack([-np.sin(pan), np.cos(pan), 0.0 * pan], axis=-1)
    z = np.cos(down) * ahead - np.sin(down) * np.array([0.0, 0.0, 1.0])
    rotation = np.stack([x, np.cross(z, x), z], axis=-2)
    pose = Rigid(rotation, -(rotation @ center))
    return plain_camera(np.full(frames, focal), (959.5, 539.5), pose)
