"""Simulated monocular body estimates: rotations with errors, guessed depth and size (S4)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from data_contracts.arrays import Floats
from data_contracts.records import Record
from worldpose.body import BodyModel, BodyParameters, load_open_body
from worldpose.formats import write_archive
from worldpose.geometry import Camera, Rigid
from worldpose.simulation.processes import drift


class MonocularErrors(Record):
    """Errors of such methods; together 80 mm of mean joint distance after alignment (PA-MPJPE)."""

    turn: float = Field(default=0.135, ge=0, le=100)
    """Error of every joint's rotation, standard deviation about each axis [rad]."""
    facing: float = Field(default=0.2, ge=0, le=100)
    """Error of the pelvis' rotation, about each axis [rad]."""
    time: float = Field(default=0.4, gt=0, le=100)
    """Time constant of the errors' correlation [s]: images hardly change."""
    white: float = Field(default=0.3, ge=0, le=1)
    """Share of the errors' variance that is independent per frame [1]."""
    size: float = Field(default=0.1, ge=0, le=10)
    """Error of the scale in the crop, relative [1]: children look like adults far away."""
    place: float = Field(default=0.03, ge=0, le=10)
    """Error of a box's centre, along each image axis [box side]."""
    missed: float = Field(default=0.1, ge=0, lt=1)
    """Share of bodies in the image that are not found [1]."""


def estimate_bodies(
    model: BodyModel,
    bodies: BodyParameters,
    camera: Camera,
    fps: float,
    errors: MonocularErrors,
    rng: np.random.Generator,
) -> dict[str, NDArray[np.generic]]:
    """Return estimates of a clip's bodies in 4DHumans' format, a row for each found body.

    Arrays: `frame`, `global_orient` (rows, 1, 3, 3) relative to a camera that looks at the crop's
    middle, `body_pose` (rows, 23, 3, 3), `betas` (rows, shapes) without person-specific shape,
    `pred_cam` (rows, 3), the crop's weak perspective: scale and offset [1], `box_center` (rows, 2)
    [px], `box_size` (rows,) [px], `img_size` (rows, 2) [px]. The order of a frame's rows does not
    identify persons.

    Args:
        model: the bodies'.
        bodies: (frames, persons), world; NaN where missing.
        camera: batch (frames,).
        fps: [1/s].
        errors: of the method.
        rng: draws the same numbers for any people in the image.
    """
    frames, persons = bodies.batch_shape
    given = np.concatenate([bodies.global_orient, bodies.body_pose], axis=-1)
    turns = Rigid.from_rotvec(given.reshape(frames, persons, -1, 3), np.zeros(3)).rotation
    slow = drift((frames, persons, *turns.shape[2:3], 3), errors.time, fps, rng)
    white = rng.standard_normal(slow.shape)
    off = np.sqrt(1.0 - errors.white) * slow + np.sqrt(errors.white) * white
    off[:, :, 0] *= errors.facing
    off[:, :, 1:] *= errors.turn
    size = 1.0 + errors.size * drift((frames, persons), errors.time, fps, rng)
    shifted = errors.place * drift((frames, persons, 2), errors.time, fps, rng)
    missed = rng.random((frames, persons)) < errors.missed
    order = rng.permuted(np.broadcast_to(np.arange(persons), (frames, persons)), axis=1)

    joints = model.articulate(bodies).joints + bodies.transl[..., None, :]
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, -1, 2)
    low, high = image.min(axis=2), image.max(axis=2)
    side = 1.2 * (high - low).max(axis=-1)
    center = 0.5 * (low + high) + shifted * side[..., None]
    inside = (center >= 0.0).all(-1) & (center < camera.image_size[:, None] - 1.0).all(-1)
    there = inside & ~missed & np.isfinite(side)
    frame, place = np.nonzero(np.take_along_axis(there, order, axis=1))
    person = order[frame, place]

    found = turns[frame, person] @ Rigid.from_rotvec(off[frame, person], np.zeros(3)).rotation
    seen_at = camera[frame].normalize(center[frame, person][:, None])[:, 0]
    ray = np.concatenate([seen_at, np.ones((len(frame), 1))], axis=-1)
    to_crop = _facing(ray / np.linalg.norm(ray, axis=-1, keepdims=True))
    found[:, 0] = to_crop @ camera.cam_from_world.rotation[frame] @ found[:, 0]
    # Scale 2 / (1.7 m) is a crop as high as an adult of 1.7 m.
    scale = 2.0 * size[frame, person] / (1.2 * 1.7)
    offset = (image[frame, person, 0] - center[frame, person]) / (0.5 * side[frame, person, None])
    pelvis = model.joint_template[0, :2] * [1.0, -1.0]
    return {
        "frame": frame,
        "global_orient": found[:, :1],
        "body_pose": found[:, 1:],
        "betas": np.zeros((len(frame), model.shapes)),
        "pred_cam": np.concatenate([scale[:, None], offset / scale[:, None] - pelvis], axis=-1),
        "box_center": center[frame, person],
        "box_size": side[frame, person],
        "img_size": camera.image_size[frame],
    }


def write_estimates(
    path: Path, poses: BodyParameters, camera: Camera, fps: float, seed: int
) -> None:
    """Write the results of `estimate_bodies` for a scene's open bodies.

    Args:
        path: the npz file.
        poses: (persons, frames), world.
        camera: batch (frames,).
        fps: [1/s].
        seed: of the scene.
    """
    given = (poses.betas, poses.global_orient, poses.body_pose, poses.transl)
    bodies = BodyParameters(*(np.swapaxes(values, 0, 1) for values in given))
    rng = np.random.default_rng([seed, 5])
    estimates = estimate_bodies(load_open_body(), bodies, camera, fps, MonocularErrors(), rng)
    write_archive(path, estimates)


def _facing(ahead: Floats) -> Floats:
    """Return the smallest rotations (n, 3, 3) from directions (n, 3) to straight ahead."""
    across = np.cross(ahead, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.arctan2(sine, ahead[:, 2:])
    return Rigid.from_rotvec(across / np.maximum(sine, 1e-12) * angle, np.zeros(3)).rotation
