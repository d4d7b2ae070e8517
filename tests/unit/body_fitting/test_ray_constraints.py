"""Lines of sight of joints that one camera alone sees, and the moving camera as a view."""

from __future__ import annotations

import numpy as np
import pytest
from test_monocular import broadcast, crowd
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from data_contracts.keypoints import KeypointDetections
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.evidence import PersonEvidence
from worldpose.body_fitting.ray_constraints import (
    constrain_to_rays,
    find_ray_constraints,
    identify_people,
    shift_frames,
)
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings

CAMERA = broadcast(1)


def tracked(keypoints, index):
    return KeypointDetections.from_keypoints(keypoints, keypoints[..., 0], index)


def scene(frames, hidden):
    """A person who weaves before one camera, and the joints, without `hidden` frames."""
    rng = np.random.default_rng(6)
    truth = walker(frames, rng)
    weaving = 0.3 * np.sin(2.0 * np.pi * 0.8 * np.arange(frames) / 50.0)
    truth = BodyParameters(
        truth.betas,
        truth.global_orient,
        truth.body_pose,
        truth.transl + weaving[:, None] * [1.0, 0.0, 0.0],
    )
    exact = KEYPOINTS(truth)
    joints, covariance = seen(truth, 0.01, rng)
    joints[hidden] = np.nan
    keypoints = CAMERA.project(exact[:, None].reshape(frames, 1, 17, 3))[:, :, None]
    return exact, joints, covariance, keypoints, np.zeros((frames, 1, 1), dtype=np.int64)


def test_lines_pass_through_the_joints_they_see():
    exact, joints, _, keypoints, index = scene(30, slice(10, 20))
    lines = find_ray_constraints(CAMERA, tracked(keypoints, index), joints)
    assert lines.seen[10:20].all() and not lines.seen[:10].any() and not lines.seen[20:].any()
    off = np.einsum("fpjab,fpjb->fpja", lines.across, lines.points - exact[:, None])
    # The joints of a person stand 0.8 rad / 70 from his middle at most, and the points 1 m too far
    # or too near.
    assert np.linalg.norm(off, axis=-1)[10:20].max() < 0.015
    # Required distance of the line's point from the track, whose walker swings the arms.
    assert np.linalg.norm(lines.points - exact[:, None], axis=-1)[10:20].max() < 0.8


def test_joints_that_two_cameras_see_or_none_have_no_line():
    _, joints, _, keypoints, index = scene(12, slice(4, 8))
    keypoints[5, 0, 0, 3] = np.nan
    lines = find_ray_constraints(CAMERA, tracked(keypoints, index), joints)
    assert np.isnan(lines.points[5, 0, 3]).all() and np.isfinite(lines.points[5, 0, 4]).all()
    two = type(CAMERA).stack([CAMERA[0], CAMERA[0]])
    twice = tracked(np.repeat(keypoints, 2, axis=1), np.repeat(index, 2, axis=1))
    both = find_ray_constraints(two, twice, joints)
    assert not both.seen.any()
    unseen = find_ray_constraints(CAMERA, tracked(keypoints, np.full_like(index, -1)), joints)
    assert not unseen.seen.any() and not unseen.across.any()


def test_stretches_of_one_view_are_filled_better_than_by_motion_alone():
    length = 25
    hidden = slice(20, 20 + length)
    exact, joints, covariance, keypoints, index = scene(40 + length, hidden)
    settings = BodyFittingSettings(max_filled_gap_s=2.0)
    lines = find_ray_constraints(CAMERA, tracked(keypoints, index), joints)
    alone = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), settings)
    lined = fit_bodies(
        MODEL, ClipEvidence(joints, covariance, 50.0, ray_constraints=[lines]), settings
    )
    before, after = (
        np.linalg.norm(x.joints - exact[:, None], axis=-1)[hidden].mean() for x in (alone, lined)
    )
    # Half a second is 64 % of what it was, one and a half are 22 %.
    assert after < 0.75 * before
    np.testing.assert_array_equal(
        np.flatnonzero(lined.filled[:, 0]), np.arange(*hidden.indices(999))
    )
    trace = np.trace(lined.covariance[:, 0, 11], axis1=-2, axis2=-1)
    middle = 20 + length // 2
    # Less sure than where it was triangulated, and the less the longer ago.
    assert trace[middle] > 1.5 * trace[10]


def shuffled(camera, joints, rng):
    """Keypoints (frames, detections, 17, 2) in no order of persons, and which is whose."""
    frames, persons = joints.shape[:2]
    image = camera.project(joints.reshape(frames, -1, 3)).reshape(frames, persons, 17, 2)
    order = rng.permuted(np.tile(np.arange(persons), (frames, 1)), axis=1)
    return np.take_along_axis(image, order[..., None, None], axis=1), image


def test_people_are_recognised_in_every_picture():
    camera, joints = broadcast(12), KEYPOINTS(crowd(12))
    keypoints, own = shuffled(camera, joints, np.random.default_rng(1))
    # 0.2 m off is a ninth of a person's height, within the gate; people are 4 m apart.
    found = identify_people(camera, keypoints, joints + [0.2, 0.0, 0.0])
    np.testing.assert_array_equal(found, own)


def test_lines_of_a_moving_camera_pass_through_what_it_sees():
    camera, joints = broadcast(6), KEYPOINTS(crowd(6))
    keypoints = camera.project(joints.reshape(6, -1, 3)).reshape(6, 3, 17, 2)
    keypoints[2, 1] = np.nan
    lines = constrain_to_rays(camera, keypoints, joints)
    assert not lines.seen[2, 1] and lines.seen.sum() == 17
    # The point nearest to the joint itself is the joint.
    np.testing.assert_allclose(lines.points[lines.seen], joints[lines.seen], atol=1e-8)


def test_two_lines_make_a_joint_and_one_more_makes_it_surer():
    settings = BodyFittingSettings()
    nothing = PersonEvidence(np.full((1, 17, 3), np.nan), np.zeros((1, 17, 3, 3)))
    across_x, across_y = np.diag([0.0, 1.0, 1.0]), np.diag([1.0, 0.0, 1.0])

    def line(point, across):
        shape = (1, 17, 3)
        return np.broadcast_to(point, shape), np.broadcast_to(across, (*shape, 3)), 50.0, settings

    one = nothing.add_rays(*line([4.0, 2.0, 1.0], across_x))
    two = one.add_rays(*line([3.0, 7.0, 1.0], across_y))
    # One knows y and z, the other x and z. 1e-6 1/m^2 against 28 to 280 is 0.2 um of metres.
    np.testing.assert_allclose(two.joints[0], np.tile([3.0, 2.0, 1.0], (17, 1)), atol=1e-6)
    np.testing.assert_allclose(two.information, two.information.swapaxes(-1, -2))
    assert (np.linalg.eigvalsh(two.information) > 0.9 * one.information[..., :1, :1] + 1.0).all()
    np.testing.assert_allclose(one.joints[0], np.tile([4.0, 2.0, 1.0], (17, 1)))


@pytest.mark.parametrize(
    ("late", "expected"),
    [(0.0, [1, 2, 4]), (0.5, [1.5, 3, np.nan]), (-0.25, [np.nan, 1.75, 3.5])],
)
def test_values_between_frames_lie_on_lines(late, expected):
    values = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(shift_frames(values, late), expected)
