"""A laboratory of its own: few given cameras around people who cross, no pitch, biased keypoints.

It uses nothing of `worldpose.simulation`: another skeleton, another way to walk, another
detector and another rig.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.clip import Clicks, Clip
from worldpose.geometry.cameras import Camera
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints
from worldpose.triangulation.settings import TriangulationSettings

FPS = 25.0
SIZE = (1280, 960)
# Joints of a standing person of height one: x to the left, y forward, z up.
BODY = np.array(
    [
        *([0.0, 0.06, 0.93], [0.02, 0.05, 0.95], [-0.02, 0.05, 0.95]),
        *([0.045, 0.0, 0.94], [-0.045, 0.0, 0.94], [0.11, 0.0, 0.81], [-0.11, 0.0, 0.81]),
        *([0.14, 0.0, 0.63], [-0.14, 0.0, 0.63], [0.15, 0.03, 0.48], [-0.15, 0.03, 0.48]),
        *([0.05, 0.0, 0.52], [-0.05, 0.0, 0.52], [0.055, 0.0, 0.28], [-0.055, 0.0, 0.28]),
        *([0.055, 0.0, 0.05], [-0.055, 0.0, 0.05]),
    ]
)
# How far each joint swings forward and back with a step.
SWING = np.array([0, 0, 0, 0, 0, 0.02, -0.02, 0.06, -0.06, 0.13, -0.13, 0, 0, -0.1, 0.1, -0.2, 0.2])


class Lab(NamedTuple):
    """A clip with what is true of it."""

    clip: Clip
    true: Camera
    joints: np.ndarray
    """(frames, persons, 17, 3) [m], world."""


def ring(count, rng, radius=4.6):
    """Cameras around the origin that look inwards."""
    angles = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.25, 0.25, count)) / count
    centers = []
    for angle in angles:
        distance = radius * rng.uniform(0.9, 1.15)
        centers.append((distance * np.cos(angle), distance * np.sin(angle), rng.uniform(1.4, 2.6)))
    focal = rng.uniform(900.0, 1150.0, count)
    middle = np.array(SIZE) / 2.0 + rng.normal(0.0, 6.0, (count, 2))
    return Camera.stack(
        [
            look_at_camera(centers[n], (0.0, 0.0, 0.95), focal[n], SIZE, middle=middle[n])
            for n in range(count)
        ]
    )


def crossing_people(frames, persons, rng):
    """Joints (frames, persons, 17, 3) of people who walk to and fro through the middle."""
    time = np.arange(frames) / FPS
    joints = np.empty((frames, persons, 17, 3))
    for person in range(persons):
        heading = np.pi * (person + rng.uniform(-0.2, 0.2)) / persons
        pace, start = rng.uniform(0.35, 0.6), rng.uniform(0.0, 2.0 * np.pi)
        along = 1.7 * np.sin(pace * time + start)
        across = 0.5 * np.sin(0.7 * pace * time + 2.0 * start)
        way = np.array([np.cos(heading), np.sin(heading)])
        place = along[:, None] * way + across[:, None] * [-way[1], way[0]]
        velocity = np.gradient(place, axis=0)
        yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])) - np.pi / 2.0
        body = np.tile(BODY, (frames, 1, 1))
        body[..., 1] += np.sin(6.0 * time + start)[:, None] * SWING
        body *= rng.uniform(1.6, 1.9)
        turned = body.copy()
        turned[..., 0] = np.cos(yaw)[:, None] * body[..., 0] - np.sin(yaw)[:, None] * body[..., 1]
        turned[..., 1] = np.sin(yaw)[:, None] * body[..., 0] + np.cos(yaw)[:, None] * body[..., 1]
        turned[..., :2] += place[:, None]
        joints[:, person] = turned
    return joints


def detected(cameras, joints, rng, bias=0.02, noise=0.025, missing=0.08, gross=0.02):
    """Keypoints (frames, cameras, persons, 17, 2) with the errors of a detector [px].

    Errors are metres at the person: a bias of each joint that depends on the view and stays, noise
    that lasts 0.2 s, and some gross errors.
    """
    frames, persons = joints.shape[:2]
    count = len(cameras.focal)
    pixels = cameras.project(joints.reshape(-1, 3)).reshape(count, frames, persons, 17, 2)
    pose = cameras.cam_from_world
    depth = np.einsum("ci,tpji->ctpj", pose.rotation[:, 2], joints)
    depth += pose.translation[:, 2][:, None, None, None]
    scale = (cameras.focal[:, 0][:, None, None, None] / depth)[..., None]
    lasting = bias * rng.standard_normal((count, 1, 1, 17, 2))
    lasting = lasting + 0.5 * bias * rng.standard_normal((count, 1, persons, 17, 2))
    moving = np.empty(pixels.shape)
    keep = np.exp(-1.0 / (0.2 * FPS))
    moving[:, 0] = rng.standard_normal(moving[:, 0].shape)
    for frame in range(1, frames):
        fresh = rng.standard_normal(moving[:, 0].shape)
        moving[:, frame] = keep * moving[:, frame - 1] + np.sqrt(1.0 - keep**2) * fresh
    pixels += scale * (lasting + noise * moving)
    wrong = rng.random(pixels.shape[:-1]) < gross
    pixels[wrong] += (scale * 0.3 * rng.standard_normal(pixels.shape))[wrong]
    pixels[rng.random(pixels.shape[:-1]) < missing] = np.nan
    return np.ascontiguousarray(pixels.swapaxes(0, 1))


def make_lab(
    seed, cameras=4, persons=3, frames=150, center=0.0, rotation=0.0, focal=None, radius=4.6
):
    """Return a laboratory whose cameras are given with errors.

    Args:
        seed: of everything.
        cameras: how many.
        persons: how many.
        frames: how many.
        center: error of camera centers, standard deviation along each axis [m].
        rotation: error about each axis, standard deviation [rad].
        focal: factor on the focal length of camera 1.
        radius: of the ring [m].
    """
    rng = np.random.default_rng(seed)
    true = ring(cameras, rng, radius)
    joints = crossing_people(frames, persons, rng)
    keypoints = detected(true, joints, rng)
    step = np.zeros((cameras, 12))
    step[:, :3] = rotation * rng.standard_normal((cameras, 3))
    step[:, 3:6] = center * rng.standard_normal((cameras, 3))
    given = step_camera(true, step)
    if focal is not None:
        wrong = given.focal.copy()
        wrong[1] *= focal
        given = replace(given, focal=wrong)
    index = np.broadcast_to(np.arange(persons), (frames, cameras, persons)).astype(np.int16)
    confidence = np.where(np.isfinite(keypoints[..., 0]), 0.8, np.nan)
    settings = TriangulationSettings()
    seen = KeypointDetections.from_keypoints(keypoints, confidence, index, np.arange(frames))
    placed = triangulate_joints(given, seen, settings)
    clip = Clip(
        cameras=given,
        covariance=np.zeros((cameras, 12, 12)),
        clicks=(Clicks.none(),) * cameras,
        fps=FPS,
        detections=seen,
        joints=placed.joints,
        views=placed.views.astype(np.int64),
        triangulation=settings,
    )
    return Lab(clip, true, joints)


def triangulated(lab, cameras, covariance=None):
    """Joints of the laboratory's people with some cameras."""
    clip = lab.clip
    return triangulate_joints(cameras, clip.detections, clip.triangulation, covariance).joints


def joint_error(lab, joints, aligned=False):
    """Mean distance of joints from the true ones [m], also after a rotation and a shift of all."""
    found = np.isfinite(joints[..., 0])
    ours, true = joints[found], lab.joints[found]
    if aligned:
        ours, true = ours - ours.mean(axis=0), true - true.mean(axis=0)
        left, _, right = np.linalg.svd(ours.T @ true)
        ours = ours @ (left * [1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return float(np.linalg.norm(ours - true, axis=-1).mean())


def errors(cameras, true):
    """Return the mean reprojection error [px] of people's positions per camera."""
    places = np.array([[x, y, 1.0] for x in (-8.0, 0.0, 8.0) for y in (-8.0, 0.0, 8.0)])
    return np.linalg.norm(cameras.project(places) - true.project(places), axis=-1).mean(axis=-1)
