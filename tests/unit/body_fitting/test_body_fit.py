"""Fits of bodies whose truth is known, and of data at its worst."""

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, seen, walker

from worldpose.body.model import BodyParameters
from worldpose.body_fitting import estimate
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.evidence import JOINT_SPREAD, MIRRORED_OFFSETS, body_axes
from worldpose.body_fitting.report import far_offsets, report_fit
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.errors import InputError

SETTINGS = BodyFittingSettings()


def height(betas):
    return np.ptp(MODEL.template[:, 1] + MODEL.shape_directions[:, 1] @ betas)


@pytest.mark.parametrize("upside_down", [False, True], ids=["upright", "upside down"])
def test_a_noisy_walker_comes_out_nearer_than_the_joints_that_were_seen(upside_down):
    rng = np.random.default_rng(7)
    truth = walker(60, rng, upside_down=upside_down)
    joints, covariance = seen(truth, 0.03, rng)
    fit = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), SETTINGS)
    exact = KEYPOINTS(truth)[:, None]
    before, after = (np.linalg.norm(x - exact, axis=-1).mean() for x in (joints, fit.joints))
    assert after < 0.7 * before
    # One person, 1.2 s, no ground: offsets and size are known to a few centimetres.
    assert height(fit.betas[0]) == pytest.approx(height(truth.betas[0]), abs=0.06)
    np.testing.assert_allclose(KEYPOINTS(fit.parameters), fit.joints, atol=1e-9)


def test_what_a_detector_always_gets_wrong_is_found():
    rng = np.random.default_rng(9)
    unknowns = np.zeros(26)
    unknowns[2] = 0.05  # of the eyes, forward
    offsets = MIRRORED_OFFSETS @ unknowns
    truths = [walker(60, rng) for _ in range(4)]
    # A detector sees eyes better than hips, and triangulation states it.
    parts = [seen(truth, 0.01 * JOINT_SPREAD, rng) for truth in truths]
    joints = np.concatenate([part[0] for part in parts], axis=1)
    covariance = np.concatenate([part[1] for part in parts], axis=1)
    joints = joints + np.einsum("fpab,jb->fpja", body_axes(joints), offsets)
    fit = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), SETTINGS)
    moved = np.abs(offsets).max(axis=-1) > 0.0
    # A head is rigid, so that pose explains nothing of it, and shape and the prior but a part.
    np.testing.assert_allclose(fit.offsets[moved], offsets[moved], atol=0.02)


# Frames 600 to 900 are a window, solved with 150 frames before and after: all of it is in the gap,
# or the person is back, or was last seen, beside the frames that are kept.
def test_long_tracks_are_solved_in_windows_with_the_same_result(monkeypatch):
    lost = 200
    back = 920
    rng = np.random.default_rng(11)
    truth = walker(1300, rng)
    joints, covariance = seen(truth, 0.03, rng)
    joints[lost:back] = np.nan
    joints[1200:1230, 0, :9] = np.nan
    evidence = ClipEvidence(joints, covariance, 50.0)
    whole = fit_bodies(MODEL, evidence, SETTINGS)
    monkeypatch.setattr(estimate, "WINDOW_FRAMES", 300)
    fit = fit_bodies(MODEL, evidence, SETTINGS)
    gone = np.isnan(fit.joints[:, 0, 0, 0])
    np.testing.assert_array_equal(gone, np.isnan(whole.joints[:, 0, 0, 0]))
    np.testing.assert_array_equal(np.flatnonzero(gone), np.arange(lost, back))
    # At a gap that a whole window lies in, motion is not carried over from the other side.
    far = ~gone & ((np.arange(1300) < lost - 60) | (np.arange(1300) >= back + 60))
    np.testing.assert_allclose(fit.joints[far], whole.joints[far], atol=1e-6)
    np.testing.assert_allclose(fit.covariance[far], whole.covariance[far], rtol=2e-3, atol=1e-10)
    near = ~gone & ~far
    exact = KEYPOINTS(truth)[near, None]
    errors = [np.linalg.norm(one.joints[near] - exact, axis=-1).mean() for one in (whole, fit)]
    assert errors[1] < 1.05 * errors[0]


def test_regions_hold_the_true_joints_in_sight_and_in_filled_gaps():
    rng = np.random.default_rng(20)
    truths = [walker(75, rng) for _ in range(4)]
    parts = [seen(truth, 0.03, rng) for truth in truths]
    joints, covariance = (np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1))
    joints[30:42] = np.nan
    fit = fit_bodies(MODEL, ClipEvidence(joints, covariance, 50.0), SETTINGS)
    np.testing.assert_array_equal(np.flatnonzero(fit.filled.all(axis=1)), np.arange(30, 42))
    away = fit.joints - np.stack([KEYPOINTS(truth) for truth in truths], axis=1)
    square = np.einsum("fpja,fpjab,fpjb->fpj", away, np.linalg.inv(fit.covariance), away)
    # 95 % regions, stated rather too large: joints here have no bias of their own.
    for frames in (slice(0, 30), slice(30, 42)):
        assert (square[frames] < 7.815).mean() > 0.9
    variance = np.trace(fit.covariance[:, :, 11], axis1=-2, axis2=-1).mean(axis=1)
    assert variance[36] > variance[32] > variance[25]


def test_people_without_any_joint_and_clips_without_people_are_missing():
    nobody = np.full((4, 1, 17, 3), np.nan)
    fit = fit_bodies(MODEL, ClipEvidence(nobody, np.full((4, 1, 17, 3, 3), np.nan), 50.0), SETTINGS)
    assert np.isnan(fit.joints).all() and np.isnan(fit.betas).all() and not fit.filled.any()
    report = report_fit(fit, nobody, 50.0)
    assert report.bodies == 0 and report.residual_m == (None,)
    none = fit_bodies(
        MODEL, ClipEvidence(nobody[:, :0], np.empty((4, 0, 17, 3, 3)), 50.0), SETTINGS
    )
    assert none.joints.shape == (4, 0, 17, 3)


def test_feet_stand_still_and_not_below_the_ground():
    rng = np.random.default_rng(13)
    stands = walker(1, rng)
    stands = BodyParameters(
        stands.betas, stands.global_orient, np.tile(stands.body_pose, (40, 1)), stands.transl
    )
    exact = KEYPOINTS(stands)
    sole = exact[0, 15:, 2].min() - 0.08
    joints, covariance = seen(stands, 0.02, rng)
    fit = fit_bodies(
        MODEL, ClipEvidence(joints, covariance, 50.0), SETTINGS, lambda x, y: sole + 0.0 * x
    )
    step = np.linalg.norm(np.diff(fit.joints[:, 0, 15:], axis=0), axis=-1)
    assert np.median(step) < 0.004
    report = report_fit(fit, joints, 50.0)
    assert report.bodies == 40 and report.skating_m[0] < 0.004


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="body fitting"):
        fit_bodies(
            MODEL, ClipEvidence(np.zeros((3, 1, 14, 3)), np.zeros((3, 1, 14, 3, 3)), 50.0), SETTINGS
        )
    joints, bias = np.zeros((1, 1, 17, 3)), np.full(17, 0.03)
    alone = 0.01**2 * np.broadcast_to(np.eye(3), (1, 1, 17, 3, 3))
    whole = alone + np.float32(0.03**2 - 0.01**2) * np.eye(3)  # nothing else, rounded
    ClipEvidence(joints, (whole - alone).astype(np.float32), 50.0, bias)
    with pytest.raises(InputError, match=r"common_bias.*covariance of 17 joints"):
        ClipEvidence(joints, alone, 50.0, bias)


def test_offsets_are_far_beyond_the_chance_of_all_joints_together():
    rng, bias = np.random.default_rng(5), np.full(17, 0.018)
    left = [0, 1, 3, 5, 7, 9, 11, 13, 15]  # both sides have the same offset
    clips = np.zeros((2000, 17, 3))
    clips[:, left] = 0.018 * rng.standard_normal((2000, 9, 3))
    assert sum(bool(far_offsets(clip, bias)) for clip in clips) <= 8  # 2 of 2000 are expected
    clips[0, 3] = [0.09, 0.0, 0.0]
    assert far_offsets(clips[0], bias)["ear"] == pytest.approx((0.09, 0.08226))
    assert not far_offsets(clips[0], np.zeros(17))  # not known
