"""Bodies fitted to known joints: shape, objective, points and constraints by rays."""

from dataclasses import replace

import numpy as np
import pytest
from walking_bodies import KEYPOINTS, MODEL, panning_camera, seen, walker

from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import fold_keypoints
from worldpose.body_fitting import estimate
from worldpose.body_fitting.bones import Shape, agree, pool_shapes
from worldpose.body_fitting.estimate import fit_bodies
from worldpose.body_fitting.evidence import (
    JOINT_SPREAD,
    MIRRORED_OFFSETS,
    Contacts,
    PersonEvidence,
    body_axes,
)
from worldpose.body_fitting.extra_points import perceived_points
from worldpose.body_fitting.pose_space import GATHER, load_pose_prior
from worldpose.body_fitting.poses import PoseSolver
from worldpose.body_fitting.ray_constraints import find_ray_constraints
from worldpose.body_fitting.report import far_offsets, report_fit
from worldpose.body_fitting.residuals import PersonObjective, Pose
from worldpose.body_fitting.results import ClipEvidence
from worldpose.body_fitting.settings import BodyFittingSettings
from worldpose.body_fitting.shapes import fit_shapes, spread_intervals
from worldpose.errors import InputError
from worldpose.triangulation.results import ExtraJoints

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
    stands = replace(stands, body_pose=np.tile(stands.body_pose, (40, 1)))
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
    ClipEvidence(joints, (whole - alone).astype(np.float32), 50.0, bias).require_bias()
    ClipEvidence(joints, -alone, 50.0, np.zeros(17)).require_bias()  # no bias is to blame
    with pytest.raises(InputError, match=r"common_bias.*covariance of 17 joints"):
        fit_bodies(MODEL, ClipEvidence(joints, alone, 50.0, bias), SETTINGS)


def test_offsets_are_far_beyond_the_chance_of_all_joints_together():
    rng, bias = np.random.default_rng(5), np.full(17, 0.018)
    left = [0, 1, 3, 5, 7, 9, 11, 13, 15]  # both sides have the same offset
    clips = np.zeros((2000, 17, 3))
    clips[:, left] = 0.018 * rng.standard_normal((2000, 9, 3))
    assert sum(bool(far_offsets(clip, bias)) for clip in clips) <= 8  # 2 of 2000 are expected
    clips[0, 3] = [0.09, 0.0, 0.0]
    assert far_offsets(clips[0], bias)["ear"] == pytest.approx((0.09, 0.08226))
    assert not far_offsets(clips[0], np.zeros(17))  # not known


SOLVER = PoseSolver(ChainedKeypoints.of(KEYPOINTS), load_pose_prior(), SETTINGS, None)


def people(count, frames, noise, seed=5):
    """Walkers, and their joints and covariance by person."""
    rng = np.random.default_rng(seed)
    truths = [walker(frames, rng) for _ in range(count)]
    parts = [seen(truth, noise, rng) for truth in truths]
    return truths, {p: (part[0][:, 0], part[1][:, 0]) for p, part in enumerate(parts)}


def fit(joints, known=None, solver=SOLVER):
    """Shapes of people, from the intervals of their tracks that the settings choose."""
    sampled = {
        person: [
            (places[part], covariance[part])
            for part in spread_intervals(len(places), 50.0, solver.settings)
        ]
        for person, (places, covariance) in joints.items()
    }
    return fit_shapes(solver, sampled, known or {}, 50.0)


@pytest.mark.parametrize("frames", [100, pytest.param(1500, marks=pytest.mark.slow)])
def test_neither_people_nor_offsets_grow_with_the_length_of_a_clip(frames):
    truths, joints = people(3, frames, 0.02)
    shapes = fit(joints)
    off = [height(shapes.people[p].betas) - height(t.betas[0]) for p, t in enumerate(truths)]
    # Nobody stands on a ground and the detector has no offsets. Noise leaves 10 mm and 3 mm; with
    # the poses' own weight of the prior and all frames, 1500 of them make it 128 mm and 24 mm.
    assert np.abs(off).max() < 0.02
    assert np.sqrt((shapes.offsets**2).mean()) < 0.005


def test_what_other_clips_know_of_a_person_counts():
    truths, joints = people(1, 50, 0.04)
    true = truths[0].betas[0]
    sure = Shape(true, 1e-4 * np.eye(MODEL.shapes))
    alone = fit(joints).people[0]
    known = fit(joints, {0: sure}).people[0]
    assert np.linalg.norm(known.betas - true) < 0.1 < np.linalg.norm(alone.betas - true)
    assert np.trace(known.covariance) < 1e-2 * np.trace(alone.covariance)


def track():
    """The objective of a walker of five frames, and a pose beside his."""
    rng = np.random.default_rng(5)
    truth = walker(5, rng)
    joints, covariance = seen(truth, 0.02, rng)
    joints[1, 0, 4] = np.nan
    contacts = Contacts(np.ones((5, 2)), np.ones((4, 2)), np.full((5, 2), 0.07))
    evidence = PersonEvidence.of(joints[:, 0], covariance[:, 0], 50.0, SETTINGS)
    chained = ChainedKeypoints.of(KEYPOINTS)
    angles = truth.body_pose @ GATHER.T + 0.1 * rng.standard_normal((5, 30))
    pose = Pose(truth.transl + 0.01, truth.global_orient, angles, truth.betas[0])
    given = (load_pose_prior(), SETTINGS, 50.0, 10.0, 0.03, contacts)
    return PersonObjective(chained, evidence, *given), pose


def test_one_motion_is_smoothed_alike_at_rates_above_120():
    """One second of one motion, without joints: E_smooth alone differs without accelerations."""
    truth = walker(241, np.random.default_rng(2), fps=240.0)
    costs = {}
    for fps, every in ((240.0, 1), (120.0, 2), (60.0, 4)):
        some = truth[::every]
        pose = Pose(some.transl, some.global_orient, some.body_pose @ GATHER.T, truth.betas[0])
        none = np.full((len(some.transl), 17, 3), np.nan), np.ones((len(some.transl), 17, 3, 3))
        own = PersonEvidence.of(*none, fps, SETTINGS)
        chained = ChainedKeypoints.of(KEYPOINTS)
        both = [
            PersonObjective(chained, own, load_pose_prior(), SETTINGS, fps, each, 0.03)
            .equations(pose, np.zeros((17, 3)), bordered=False)
            .cost
            for each in (20.0, np.inf)
        ]
        costs[fps] = both[0] - both[1]
    assert costs[240.0] == pytest.approx(costs[120.0], rel=0.05)
    # At usual rates each frame counts.
    assert costs[60.0] == pytest.approx(0.5 * costs[120.0], rel=0.05)


def test_gradient_by_frames_and_betas_agrees_with_finite_differences():
    made, pose = track()
    rng = np.random.default_rng(1)
    at = made.equations(pose, np.zeros((17, 3)), bordered=True)
    small = 1e-6
    for _ in range(5):
        step, betas = rng.standard_normal((5, 36)), rng.standard_normal(MODEL.shapes)
        costs = [
            made.equations(
                pose.apply_step(sign * small * step, sign * small * betas),
                np.zeros((17, 3)),
                bordered=True,
            ).cost
            for sign in (1.0, -1.0)
        ]
        slope = (costs[0] - costs[1]) / (2.0 * small)
        expected = (at.gradient * step).sum() + at.border_gradient[: MODEL.shapes] @ betas
        # Betas feel the smoothness only through the poses, so that it does not shorten limbs,
        # and offsets turn with the pose: both are left out, a hundredth of the whole.
        assert slope == pytest.approx(expected, rel=0.02, abs=0.02 * np.abs(at.gradient).sum())


def test_a_person_of_several_clips_is_what_they_say_together_with_anybody_counted_once():
    # Each clip knows the first component to 0.5 besides the prior: 1 / (1 + 4) of variance.
    covariance = np.diag([0.2, 1.0])
    clips = [Shape(np.array([0.8 * seen, 0.0]), covariance) for seen in (1.0, 2.0)]
    pooled = pool_shapes(clips, [1.0, 1.0])
    # Two correlated_frames of precision 4 and the prior's 1: (4 x 1 + 4 x 2) / 9.
    np.testing.assert_allclose(pooled.betas, [12.0 / 9.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pooled.covariance, np.diag([1.0 / 9.0, 1.0]), atol=1e-12)
    # The paper's shapes have no prior and no covariance: their mean, not their sum.
    mean = pool_shapes(
        [Shape(np.full(2, seen), np.eye(2)) for seen in (1.0, 2.0)],
        [BodyFittingSettings(method="paper").prior_weight] * 2,
    )
    np.testing.assert_allclose(mean.betas, 1.5, atol=1e-12)
    # One in a thousand pairs of clips of one person is farther apart, 13.8 of two betas.
    limit = np.sqrt(13.8 * 0.4)
    for apart, said in ((limit, True), (limit + 0.01, False)):
        assert agree(clips[0], Shape(clips[0].betas + [apart, 0.0], covariance)) == said


CAMERA = panning_camera(1)


def scene(frames, hidden):
    """A person who weaves before one camera, and the joints, without `hidden` frames."""
    rng = np.random.default_rng(6)
    truth = walker(frames, rng)
    weaving = 0.3 * np.sin(2.0 * np.pi * 0.8 * np.arange(frames) / 50.0)
    truth = replace(truth, transl=truth.transl + weaving[:, None] * [1.0, 0.0, 0.0])
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
    detections = KeypointDetections.from_keypoints(keypoints, keypoints[..., 0], index)
    lines = find_ray_constraints(CAMERA, detections, joints)
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


POINTS = fold_keypoints(MODEL, FEET)
NOISE = 0.01
BIAS = 0.024
LEFT = np.array([[0.0, 0.0, 0.02], [0.015, 0.0, 0.01], [0.0, 0.01, -0.02]])
OFFSETS = np.concatenate([LEFT, LEFT * [-1.0, 1.0, 1.0]])
"""Of a shoe: toes ahead and to the side, heel behind [m]: left, up, forward."""


def fitted_people(count, frames, seed, *, offsets=0.0):
    """Walkers who roll their feet: bodies, evidence with feet."""
    rng = np.random.default_rng(seed)
    bodies = []
    for n in range(count):
        body = walker(frames, rng)
        pose = body.body_pose.copy()
        wave = np.sin(2.0 * np.pi * 1.2 * np.arange(frames) / 50.0 + n)
        for joint, sign in ((7, 1.0), (8, -1.0)):
            pose[:, 3 * (joint - 1)] = 0.15 + 0.4 * sign * wave
            pose[:, 3 * (joint - 1) + 1] = 0.15 * sign
        bodies.append(replace(body, body_pose=pose))
    joints, covariance, feet = [], [], []
    for body in bodies:
        own, spread = seen(body, NOISE, rng)
        joints.append(own)
        covariance.append(spread)
        there = POINTS(body) + perceived_points(MODEL, FEET, body, offsets * np.ones((6, 3)))
        feet.append(there + NOISE * rng.standard_normal(there.shape))
    places = np.stack(feet, axis=1)
    stated = np.broadcast_to((NOISE**2 + BIAS**2) * np.eye(3), (*places.shape, 3)).copy()
    views = np.full(places.shape[:3], 4, np.uint8)
    extra = ExtraJoints(FEET, places, stated, views, np.full(6, BIAS))
    evidence = ClipEvidence(
        np.concatenate(joints, axis=1), np.concatenate(covariance, axis=1), 50.0, extra=extra
    )
    return bodies, evidence


def errors(fit, bodies):
    """Mean error of heels and toes, and of ankles [m]."""
    truth = np.stack([POINTS(body) for body in bodies], axis=1)
    ankles = np.stack([KEYPOINTS(body)[:, 15:] for body in bodies], axis=1)
    feet = np.linalg.norm(POINTS(fit.parameters) - truth, axis=-1).mean()
    return feet, np.linalg.norm(fit.joints[:, :, 15:] - ankles, axis=-1).mean()


def test_rolling_feet_are_fitted():
    bodies, evidence = fitted_people(2, 60, 1)
    without = fit_bodies(MODEL, replace(evidence, extra=None), SETTINGS)
    with_feet = fit_bodies(MODEL, evidence, SETTINGS)
    assert without.extra is None and with_feet.extra.points == FEET
    before, ankles_before = errors(without, bodies)
    after, ankles_after = errors(with_feet, bodies)
    assert before > 0.04 and after < 0.012
    assert ankles_after < ankles_before
    np.testing.assert_allclose(with_feet.extra.joints, POINTS(with_feet.parameters), atol=1e-12)
    np.testing.assert_array_equal(without.betas, with_feet.betas)  # they determine no shape


def test_offsets_of_shoes_are_learned_and_do_not_move_the_ankles():
    bodies, evidence = fitted_people(3, 60, 2, offsets=OFFSETS)
    fit = fit_bodies(MODEL, evidence, SETTINGS)
    # A turn of the foot moves all its points: what it explains is no offset.
    length = fit.extra.offsets[0, 2] - fit.extra.offsets[2, 2]
    assert length == pytest.approx(OFFSETS[0, 2] - OFFSETS[2, 2], abs=0.012)
    np.testing.assert_allclose(
        fit.extra.offsets[:3], fit.extra.offsets[3:] * [-1.0, 1.0, 1.0], atol=1e-12
    )
    feet, ankles = errors(fit, bodies)
    assert feet < 0.02 and ankles < 0.015
