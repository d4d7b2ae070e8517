"""Lines of sight of joints that one camera alone sees, and the moving camera as a view."""

from __future__ import annotations

import numpy as np
from test_monocular import broadcast
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from data_contracts.keypoints import KeypointDetections
from worldpose.body.model import BodyParameters
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.ray_constraints import find_ray_constraints
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
