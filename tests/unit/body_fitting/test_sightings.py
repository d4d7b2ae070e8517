"""Joints that one camera alone sees."""

import numpy as np
import pytest
from test_monocular_poses import broadcast
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body import BodyParameters
from worldpose.body_fitting import BodyFittingSettings, fit_bodies
from worldpose.body_fitting.ray_constraints import find_sightings

CAMERA = broadcast(1)


def scene(frames, hidden):
    """Who weaves before one camera, and his joints, without those of `hidden` frames."""
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
    lines = find_sightings(CAMERA, keypoints, index, joints)
    assert lines.seen[10:20].all() and not lines.seen[:10].any() and not lines.seen[20:].any()
    off = np.einsum("fpjab,fpjb->fpja", lines.across, lines.points - exact[:, None])
    # The joints of a person stand 0.8 rad / 70 from his middle at most, and the points 1 m too far
    # or too near.
    assert np.linalg.norm(off, axis=-1)[10:20].max() < 0.015
    # What is asked of the line's point: near the track, whose walker swings his arms.
    assert np.linalg.norm(lines.points - exact[:, None], axis=-1)[10:20].max() < 0.8


def test_joints_that_two_cameras_see_or_none_have_no_line():
    _, joints, _, keypoints, index = scene(12, slice(4, 8))
    keypoints[5, 0, 0, 3] = np.nan
    lines = find_sightings(CAMERA, keypoints, index, joints)
    assert np.isnan(lines.points[5, 0, 3]).all() and np.isfinite(lines.points[5, 0, 4]).all()
    two = type(CAMERA).stack([CAMERA[0], CAMERA[0]])
    both = find_sightings(two, np.repeat(keypoints, 2, axis=1), np.repeat(index, 2, axis=1), joints)
    assert not both.seen.any()
    unseen = find_sightings(CAMERA, keypoints, np.full_like(index, -1), joints)
    assert not unseen.seen.any() and not unseen.across.any()


def test_a_person_who_was_never_triangulated_has_no_line():
    _, joints, _, keypoints, index = scene(4, slice(0, 4))
    assert not find_sightings(CAMERA, keypoints, index, joints).seen.any()


@pytest.mark.parametrize("length", [25, 75])
def test_stretches_of_one_view_are_filled_better_than_by_motion_alone(length):
    hidden = slice(20, 20 + length)
    exact, joints, covariance, keypoints, index = scene(40 + length, hidden)
    settings = BodyFittingSettings(max_gap_s=2.0)
    lines = find_sightings(CAMERA, keypoints, index, joints)
    alone = fit_bodies(MODEL, joints, covariance, 50.0, settings)
    lined = fit_bodies(MODEL, joints, covariance, 50.0, settings, sightings=[lines])
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


def test_who_is_seen_by_one_camera_stays_longer_than_the_longest_gap():
    _, joints, covariance, keypoints, index = scene(90, slice(15, 75))
    settings = BodyFittingSettings(max_gap_s=0.5)
    lines = find_sightings(CAMERA, keypoints, index, joints)
    gone = fit_bodies(MODEL, joints, covariance, 50.0, settings)
    stays = fit_bodies(MODEL, joints, covariance, 50.0, settings, sightings=[lines])
    assert np.isnan(gone.joints[20:70]).all() and np.isfinite(stays.joints).all()
