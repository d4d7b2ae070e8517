"""Files of methods of one image: their names, shapes and conventions."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, panning_camera, seen, walker

from worldpose.body.model import BodyParameters
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.monocular import (
    MonocularPoses,
    MonocularPrior,
    join_poses,
    parse_monocular,
    place_monocular_poses,
    read_monocular,
)
from worldpose.body_fitting.pose_space import GATHER
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.errors import InputError
from worldpose.geometry.rigid import Rigid
from worldpose.simulation.detector_errors import MonocularErrors, estimate_bodies

VECTORS = np.random.default_rng(0).normal(0.0, 0.4, (3, 24, 3))
MATRICES = Rigid.from_rotvec(VECTORS, np.zeros(3)).rotation
CROP = {"box_center": np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]])}

LAYOUTS = {
    "4DHumans": {
        "global_orient": MATRICES[:, :1],
        "body_pose": MATRICES[:, 1:],
        "pred_cam": np.ones((3, 3)),
        "box_size": np.ones(3),
        **CROP,
    },
    "HybrIK": {
        "pred_thetas": MATRICES.reshape(3, 216),
        "bbox": np.array(
            [[0.0, 0.0, 20.0, 40.0], [20.0, 20.0, 40.0, 60.0], [40.0, 50.0, 60.0, 70]]
        ),
    },
    "SMPL in vectors": {
        "global_orient": VECTORS[:, 0],
        "body_pose": VECTORS[:, 1:].reshape(3, 69),
        **CROP,
    },
    "SMPL in one": {"poses": VECTORS.reshape(3, 72), **CROP},
    "VIBE": {
        "pose": VECTORS.reshape(3, 72),
        "bboxes": np.append(CROP["box_center"], [[6.0, 9.0]] * 3, axis=1),
        "frame_ids": np.array([4, 4, 7]),
    },
}


def written(tmp_path, arrays):
    path = tmp_path / "estimates.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize("layout", LAYOUTS)
def test_turns_and_crops_are_the_same_whatever_the_method(tmp_path, layout):
    frame = {} if "frame_ids" in LAYOUTS[layout] else {"frame": np.array([4.0, 4.0, 7.0])}
    found = read_monocular(written(tmp_path, LAYOUTS[layout] | frame))
    np.testing.assert_allclose(found.rotations, MATRICES, atol=1e-12)
    np.testing.assert_array_equal(found.center, CROP["box_center"])
    np.testing.assert_array_equal(found.frame, [4, 4, 7])
    assert found.cropped


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"box_center": None}, "a crop"),
        ({"body_pose": None}, "body_pose"),
        ({"body_pose": np.zeros((3, 21, 3))}, "23 joints"),
        ({"global_orient": np.zeros((2, 3))}, "2 and 3"),
        ({"frame": np.zeros(5)}, "3 frames"),
        ({"frame": np.array([1.0, 2.5, 3.0])}, "whole frame"),
        ({"frame": np.array([1.0, np.nan, 3.0])}, "whole frame"),
        ({"frame": np.array(["1", "2", "c.jpg"])}, "whole frame"),
        ({"box_center": None, "bbox": np.tile([900.0, 500.0, 1.5], (3, 1))}, "corners"),
        ({"box_center": None, "bbox": np.tile([900.0, 500.0, 120.0, 300.0], (3, 1))}, "corners"),
    ],
)
def test_files_that_lack_something_are_refused_with_its_name(tmp_path, change, says):
    arrays = {**LAYOUTS["SMPL in vectors"], **change}
    path = written(tmp_path, {name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=says) as told:
        read_monocular(path)
    assert str(path) in str(told.value)


def test_boxes_with_scores_and_classes_or_of_nobody_and_frames_as_text_are_read():
    boxes = np.array([[0.0, 0.0, 20.0, 40.0, 0.9, 0], [0.0, 8.0, 0.0, 10.0, 0.5, 0], [np.nan] * 6])
    arrays = {"poses": VECTORS.reshape(3, 72), "bbox": boxes, "frame": np.array(["7", "8", "008"])}
    found = parse_monocular(arrays, "a.npz")
    assert found.frame.tolist() == [7, 8, 8]
    np.testing.assert_array_equal(found.center, [[10.0, 20.0], [0.0, 9.0], [np.nan, np.nan]])


EXACT = MonocularErrors(turn=0.0, facing=0.0, size=0.0, place=0.0, missed=0.0)


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
    return parse_monocular(arrays, "simulated")


def test_exact_bodies_of_crops_come_back_in_the_world_at_their_persons():
    bodies, camera = crowd(6), panning_camera(6)
    joints = KEYPOINTS(bodies)
    found = place_monocular_poses(estimates(bodies, camera), camera, np.arange(6), joints)
    true = Rigid.from_rotvec(bodies.global_orient, np.zeros(3)).rotation
    np.testing.assert_allclose(found.orient, true, atol=1e-9)
    np.testing.assert_allclose(found.angles, bodies.body_pose @ GATHER.T, atol=1e-9)


def rotation(vectors):
    return Rigid.from_rotvec(vectors, np.zeros(3)).rotation


def test_a_person_has_the_pose_of_the_camera_that_shows_it_largest():
    def seen(number, heights):
        shape = np.array(heights)[None]
        orient = np.where(np.isnan(shape)[..., None, None], np.nan, np.full((1, 3, 3, 3), number))
        return MonocularPoses(orient, orient[..., 0, :1].repeat(30, -1), shape)

    found = join_poses([seen(1.0, [90.0, 40.0, np.nan]), seen(2.0, [50.0, 80.0, np.nan])])
    assert found.angles[0, :2, 0].tolist() == [1.0, 2.0]
    assert found.orient[0, :2, 2, 2].tolist() == [1.0, 2.0]
    assert np.isnan(found.orient[0, 2]).all()
    assert join_poses([]) is None


def test_right_glimpses_help_where_joints_are_missing_and_are_recorded():
    """The limbs of a walker are not triangulated for one second."""
    rng, settings = np.random.default_rng(5), BodyFittingSettings()
    truth = walker(100, rng)
    joints, covariance = seen(truth, 0.01, rng)
    joints[30:80, :, [*range(7, 11), *range(13, 17)]] = np.nan
    orient, angles = rotation(truth.global_orient)[:, None], (truth.body_pose @ GATHER.T)[:, None]
    angles = angles + 0.1 * np.random.default_rng(1).standard_normal(angles.shape)
    glimpses = MonocularPoses(orient, angles, np.ones((1, 1)))
    alone = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), settings)
    guided = fit_bodies(
        MODEL, ClipEvidence(joints, covariance, 50.0, monocular_poses=glimpses), settings
    )
    np.testing.assert_array_equal(np.flatnonzero(guided.guided[:, 0]), np.arange(30, 80))
    assert not alone.guided.any()
    exact = KEYPOINTS(truth)[:, None]
    before, after = (
        np.linalg.norm(x.joints - exact, axis=-1)[35:75].mean() for x in (alone, guided)
    )
    assert after < 0.8 * before


RNG = np.random.default_rng(2)


def test_the_pull_is_the_gradient_of_its_cost():
    orient, angles = RNG.normal(0.0, 0.8, (4, 3)), RNG.normal(0.0, 0.5, (4, 30))
    known = rotation(orient + RNG.normal(0.0, 0.3, (4, 3)))
    precision = np.diag(RNG.uniform(5.0, 50.0, 33))
    used = np.array([True, True, False, True])
    known_angles = angles + RNG.normal(0.0, 0.3, (4, 30))
    known_angles[2] = np.nan
    left = RNG.uniform(0.4, 1.0, 4)
    guidance = MonocularPrior(known, known_angles, used, precision, 20.0, left)
    step = RNG.standard_normal((4, 33))
    gradient = guidance.normal_equations(orient, angles)[1]
    costs = [
        guidance.normal_equations(
            orient + sign * 1e-6 * step[:, :3], angles + sign * 1e-6 * step[:, 3:]
        )[2]
        for sign in (1.0, -1.0)
    ]
    assert (gradient * step).sum() == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-6)
    np.testing.assert_array_equal(gradient[2], 0.0)
