"""Monocular bodies in the world: the camera, the crop's ray, and who is who."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, walker

from worldpose.body import BodyParameters
from worldpose.body_fitting.monocular import MonocularEstimates, monocular_of
from worldpose.body_fitting.monocular_poses import place_monocular_poses
from worldpose.body_fitting.pose_space import GATHER
from worldpose.geometry import Camera, Rigid
from worldpose.simulation.monocular import MonocularErrors, estimate_bodies

EXACT = MonocularErrors(turn=0.0, facing=0.0, size=0.0, place=0.0, missed=0.0)


def broadcast(frames):
    """A camera 70 m beside the pitch, 15 m up, that pans past the origin."""
    pan = np.linspace(-0.12, 0.12, frames)
    down = np.arctan2(15.0, 70.0)
    x = np.stack([np.cos(pan), np.sin(pan), 0.0 * pan], axis=-1)
    ahead = np.stack([-np.sin(pan), np.cos(pan), 0.0 * pan], axis=-1)
    z = np.cos(down) * ahead - np.sin(down) * np.array([0.0, 0.0, 1.0])
    rotation = np.stack([x, np.cross(z, x), z], axis=-2)
    center = np.array([0.0, -70.0, 15.0])
    return Camera(
        focal=np.array([4000.0, 4000.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, -(rotation @ center)),
        image_size=np.array([1920, 1080]),
    )


def crowd(frames):
    """Three walkers 3 m apart (frames, 3)."""
    rng = np.random.default_rng(3)
    each = [walker(frames, rng) for _ in range(3)]
    places = [[-3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [4.0, -2.0, 0.0]]
    return BodyParameters(
        np.stack([one.betas for one in each], axis=1),
        np.stack([one.global_orient for one in each], axis=1),
        np.stack([one.body_pose for one in each], axis=1),
        np.stack([one.transl + place for one, place in zip(each, places, strict=True)], axis=1),
    )


def estimates(bodies, camera, errors=EXACT, seed=0):
    arrays = estimate_bodies(MODEL, bodies, camera, 50.0, errors, np.random.default_rng(seed))
    return monocular_of(arrays, "simulated")


def test_exact_bodies_of_crops_come_back_in_the_world_at_their_persons():
    bodies, camera = crowd(6), broadcast(6)
    joints = KEYPOINTS(bodies)
    found = place_monocular_poses(estimates(bodies, camera), camera, np.arange(6), joints)
    true = Rigid.from_rotvec(bodies.global_orient, np.zeros(3)).rotation
    np.testing.assert_allclose(found.orient, true, atol=1e-9)
    np.testing.assert_allclose(found.angles, bodies.body_pose @ GATHER.T, atol=1e-9)


def test_a_body_of_the_whole_picture_is_not_turned_to_its_ray():
    bodies, camera = crowd(1), broadcast(1)
    joints = KEYPOINTS(bodies)
    true = Rigid.from_rotvec(bodies.global_orient, np.zeros(3)).rotation[0]
    turned = camera.cam_from_world.rotation[0] @ true
    rest = np.broadcast_to(np.eye(3), (3, 23, 3, 3))
    image = camera[0].project(joints[0].reshape(-1, 3)).reshape(3, 17, 2)
    center = 0.5 * (image.min(axis=1) + image.max(axis=1))
    rotations = np.concatenate([turned[:, None], rest], axis=1)
    whole = MonocularEstimates(np.zeros(3, dtype=np.int64), rotations, center, False)
    found = place_monocular_poses(whole, camera, np.arange(1), joints)
    np.testing.assert_allclose(found.orient[0], true, atol=1e-12)
    crop = MonocularEstimates(whole.frame, rotations, center, True)
    off = place_monocular_poses(crop, camera, np.arange(1), joints).orient[0] @ true.swapaxes(
        -1, -2
    )
    # 7 degrees and less beside the middle of the picture.
    ray = camera[0].normalize(center)
    np.testing.assert_allclose(
        np.linalg.norm(Rigid(off, np.zeros(3)).rotvec, axis=-1),
        np.arctan(np.linalg.norm(ray, axis=-1)),
        atol=1e-9,
    )


def test_people_whom_nobody_estimated_and_estimates_of_nobody_are_left_out():
    bodies, camera = crowd(4), broadcast(4)
    joints = KEYPOINTS(bodies)
    found = place_monocular_poses(estimates(bodies, camera), camera, np.arange(4), joints[:, :1])
    assert np.isfinite(found.angles).all()
    later = place_monocular_poses(estimates(bodies, camera), camera, np.array([0, 1, 7, 8]), joints)
    assert np.isfinite(later.angles[:2]).all() and np.isnan(later.angles[2:]).all()
    nobody = place_monocular_poses(estimates(bodies, camera), camera, np.arange(4), joints[:, :0])
    assert nobody.angles.shape == (4, 0, 30)
    nowhere = place_monocular_poses(estimates(bodies, camera), camera, np.arange(4), joints + 50.0)
    assert np.isnan(nowhere.angles).all() and np.isnan(nowhere.orient).all()


def test_gaps_of_a_track_are_bridged_for_who_is_who():
    bodies, camera = crowd(9), broadcast(9)
    joints = KEYPOINTS(bodies)
    joints[3:6, 1] = np.nan
    found = place_monocular_poses(estimates(bodies, camera), camera, np.arange(9), joints)
    true = Rigid.from_rotvec(bodies.global_orient, np.zeros(3)).rotation
    np.testing.assert_allclose(found.orient, true, atol=1e-9)


def test_simulated_methods_err_by_80_mm_after_alignment():
    bodies, camera = crowd(200), broadcast(200)
    found = estimates(bodies, camera, MonocularErrors(), seed=1)
    vectors = Rigid(found.rotations, np.zeros(3)).rotvec
    seen = KEYPOINTS(
        BodyParameters(np.zeros(10), vectors[:, 0], vectors[:, 1:].reshape(-1, 69), np.zeros(3))
    )
    joints = KEYPOINTS(bodies)
    image = camera.project(joints.reshape(200, -1, 3)).reshape(200, 3, 17, 2)
    middle = 0.5 * (image.min(axis=2) + image.max(axis=2))
    person = np.linalg.norm(middle[found.frame] - found.center[:, None], axis=-1).argmin(axis=1)
    true = joints[found.frame, person]
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (seen, true))
    u, values, vt = np.linalg.svd(np.einsum("nka,nkb->nab", b, a))
    sign = np.linalg.det(u @ vt)
    u[..., -1] *= sign[:, None]
    values[:, -1] *= sign
    scale = values.sum(-1) / (a**2).sum((1, 2))
    away = scale[:, None, None] * np.einsum("nab,nkb->nka", u @ vt, a) - b
    # Errors last 0.4 s: 4 s of three people are some thirty witnesses of 20 mm each.
    assert np.linalg.norm(away, axis=-1).mean() == pytest.approx(0.08, abs=0.012)
    # A tenth is missed.
    assert len(found.frame) / 600 == pytest.approx(0.9, abs=0.04)


def test_nobody_in_the_picture_gives_no_estimates():
    bodies, camera = crowd(3), broadcast(3)
    behind = BodyParameters(
        bodies.betas, bodies.global_orient, bodies.body_pose, bodies.transl - [0.0, 200.0, 0.0]
    )
    assert len(estimates(behind, camera).frame) == 0
