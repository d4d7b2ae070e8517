"""Cameras of a known scene are found from a walking person, or refused where nothing tells them."""

from dataclasses import replace

import numpy as np
import pytest
from camera_builders import look_at_camera
from rigs import errors

from data_contracts.cameras import LensCalibration
from data_contracts.keypoints import KeypointDetections
from worldpose.bundle_adjustment.clip import Clicks, propose_frames
from worldpose.bundle_adjustment.estimate import adjust_cameras, adjust_unguarded
from worldpose.bundle_adjustment.held_out_validation import held_out_errors
from worldpose.bundle_adjustment.people_cameras import KnownLength, locate_cameras
from worldpose.bundle_adjustment.settings import BundleAdjustmentSettings, SolverSettings
from worldpose.errors import InputError
from worldpose.geometry.cameras import Camera
from worldpose.geometry.lens_models import LensModel
from worldpose.geometry.rigid import align
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import simulate_scene
from worldpose.static_calibration.parameters import step_camera
from worldpose.triangulation.estimate import triangulate_joints

FPS = 50.0
SIZE = (1280, 960)
FOCAL = 900.0
NAMES = ("north", "east", "south", "west")


@pytest.fixture(scope="module")
def walkers():
    """Joints (frames, 2, 17, 3) of the two people who walk farthest, near the origin."""
    tiny = SCENARIOS["tiny"]
    scene = simulate_scene(tiny.model_copy(update={"duration": 10.0, "broadcast": ()}), 3)
    joints = scene.truth.joints
    middle = joints[:, :, [11, 12]].mean(axis=2)
    way = np.linalg.norm(np.ptp(middle, axis=0)[:, :2], axis=1)
    chosen = np.argsort(-way)[:2]
    found = joints[:, chosen]
    return found - np.array([*found[:, 0, :, :2].reshape(-1, 2).mean(axis=0), 0.0])


@pytest.fixture(scope="module")
def cameras(walkers):
    """Four cameras around the first person's way, all in front of it."""
    reach = float(np.abs(walkers[:, 0, :, :2]).max())
    found = []
    for n, angle in enumerate(np.radians([20.0, 110.0, 215.0, 300.0])):
        far = reach + 5.0 + 0.7 * n
        center = (far * np.cos(angle), far * np.sin(angle), 1.5 + 0.5 * n)
        about = {"middle": (640.0 + n, 470.0 + n), "lens": (-0.05, 0.01, 0.0, 0.0, 0.0)}
        found.append(look_at_camera(center, (0.0, 0.0, 0.9), FOCAL, SIZE, roll=0.02 * n, **about))
    return Camera.stack(found)


def lenses(cameras, names=NAMES):
    return [
        LensCalibration(
            id=name,
            image_size=SIZE,
            focal_px=float(camera.focal[0]),
            principal_point_px=tuple(camera.principal_point.tolist()),
            distortion=tuple(camera.coefficients.tolist()),
            lens_model=LensModel(int(camera.lens_model)).label,
            focal_std_px=2.0,
            principal_point_std_px=2.0,
            distortion_std=0.005,
        )
        for name, camera in zip(
            names, (cameras[c] for c in range(len(cameras.focal))), strict=False
        )
    ]


def seen(cameras, joints, noise=1.5):
    """Detections of people (frames, persons, 17, 3) with Gaussian noise [px]."""
    rng = np.random.default_rng(4)
    views = []
    for c in range(len(cameras.focal)):
        pixels = cameras[c].project(joints.reshape(-1, 3)).reshape(*joints.shape[:-1], 2)
        inside = ((pixels >= 0) & (pixels < SIZE)).all(axis=-1)
        pixels = pixels + rng.normal(0.0, noise, pixels.shape)
        views.append(np.where(inside[..., None], pixels, np.nan))
    keypoints = np.stack(views, axis=1)
    confidence = np.where(np.isfinite(keypoints[..., 0]), 0.9, np.nan)
    return KeypointDetections.from_keypoints(keypoints, confidence)


FISHEYE = [-0.08, 0.02, 0.0, 0.0, -0.01, 0.002, 0.0, 0.0]


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_walking_person_locates_four_cameras_in_metres(walkers, cameras, fisheye):
    if fisheye:
        cameras = replace(cameras, distortion=np.array(FISHEYE), lens_model=LensModel.FISHEYE)
    apart = float(np.linalg.norm(cameras.center[0] - cameras.center[2]))
    found = locate_cameras(
        lenses(cameras), seen(cameras, walkers[:, :1]), FPS, KnownLength(apart, (0, 2), 0.005)
    )
    motion = align(found.cameras.center, cameras.center, with_scale=False)
    off = np.linalg.norm(motion.apply(found.cameras.center) - cameras.center, axis=1)
    assert off.max() < 0.05
    assert (off < 4.0 * found.std[:, 0] + 0.02).all()
    turned = found.cameras.cam_from_world.rotation @ motion.rotation.T
    cosine = 0.5 * (np.einsum("cij,cij->c", turned, cameras.cam_from_world.rotation) - 1.0)
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max() < 0.5
    # The world's z is up, its origin on the ground.
    tilt = np.arccos(np.clip((motion.rotation @ [0.0, 0.0, 1.0])[2], -1.0, 1.0))
    assert tilt < max(3.0 * found.up_std, np.radians(1.0))
    assert abs(motion.apply(np.zeros((1, 3)))[0, 2]) < 0.08
    assert found.people == 1
    assert found.residual_px.max() < 3.0
    assert found.held_out_px.max() < 4.0
    assert 0.0 < found.coverage.min() <= found.coverage.max() <= 1.0


def test_stature_gives_the_scale_within_its_deviation(walkers, cameras):
    top = walkers[:, 0, :5, 2].max(axis=1) - walkers[:, 0, 15:, 2].min(axis=1)
    # Eyes are 0.11 m below the top of the head, ankles 0.08 m above the ground.
    stature = float(np.median(top)) + 0.19
    found = locate_cameras(
        lenses(cameras), seen(cameras, walkers[:, :1]), FPS, KnownLength(stature)
    )
    scale = float(align(found.cameras.center, cameras.center, with_scale=True).scale)
    assert abs(np.log(scale)) < 3.0 * found.scale_std
    assert found.stature_m == pytest.approx(stature)


def without(detections, camera, frames):
    """The detections without those of a camera in some frames."""
    confidence = detections.confidence.copy()
    confidence[frames, camera] = np.nan
    return replace(detections, confidence=confidence)


def stand_still(seen_by, walkers):
    first = walkers[:1] - np.array([*walkers[0, 0, 11, :2], 0.0])
    return seen_by(np.repeat(first, len(walkers), axis=0))


def show_apart(seen_by, walkers):
    half = len(walkers) // 2
    return without(without(seen_by(walkers), 0, slice(half, None)), 1, slice(None, half - 5))


def show_another(seen_by, walkers):
    given = seen_by(walkers)
    keypoints = given.keypoints.copy()
    keypoints[:, 1] = keypoints[::-1, 1] * [-1.0, 1.0] + [1280.0, 0.0]
    return replace(given, keypoints=keypoints)


@pytest.mark.parametrize(
    ("count", "show", "message"),
    [
        (1, lambda seen_by, walkers: seen_by(walkers), "north: expected two cameras or more"),
        (4, stand_still, "found people who stand still"),
        (2, show_apart, "in two cameras at once for 20 frames, found 5"),
        (4, lambda seen_by, walkers: without(seen_by(walkers), 2, slice(None)), "south: expected"),
        (4, show_another, "east: expected a person for 20 frames that"),
    ],
    ids=["one camera", "still", "too few frames", "nobody", "another person"],
)
def test_people_who_determine_no_cameras_are_refused(walkers, cameras, count, show, message):
    given = show(lambda joints: seen(cameras[:count], joints), walkers[:, :1])
    with pytest.raises(InputError, match=message):
        locate_cameras(lenses(cameras)[:count], given, FPS, KnownLength(1.8))


@pytest.mark.slow
def test_groups_that_show_different_people_are_named(walkers, cameras):
    first, second = (seen(cameras, walkers[:, p : p + 1] * flip) for p, flip in ((0, 1), (1, -1)))
    keypoints = np.concatenate([first.keypoints, second.keypoints[::-1]], axis=1)
    both = KeypointDetections.from_keypoints(
        keypoints, np.where(np.isfinite(keypoints[..., 0]), 0.9, np.nan)
    )
    halls = [one for hall in "ab" for one in lenses(cameras, [f"{hall}{c}" for c in range(4)])]
    with pytest.raises(InputError, match="2 groups that share no person: a0, a1, a2, a3; b0, b1"):
        locate_cameras(halls, both, FPS, KnownLength(1.8))


QUICK = BundleAdjustmentSettings(max_frames=8, folds=2, solver=SolverSettings(min_cost_change=1e-6))


def test_people_bring_cameras_together(clip):
    made, true, _ = clip()
    adjusted = adjust_cameras(made, QUICK)
    assert adjusted.accepted.all()
    # Scatter of a pixel's rotation and of decimetres becomes what 800 keypoints per camera leave;
    # what all cameras share stays as calibration has it.
    assert errors(adjusted.cameras, true).mean() < 0.4 * errors(made.cameras, true).mean()
    assert (adjusted.verdict.loss[:, 1] < adjusted.verdict.loss[:, 0]).all()
    assert all(reason.startswith("accepted") for reason in adjusted.reasons)


def test_frames_lie_apart_by_their_numbers_or_by_their_rows_without_any(clip):
    made, *_ = clip(frames=40)
    fifth = replace(made.detections, frame=5 * made.detections.frame)
    none = replace(made.detections, frame=made.detections.frame[:0])
    chosen = [
        propose_frames(replace(made, fps=fps, detections=seen), 8, 0.4, 3).tolist()
        for fps, seen in ((25.0, made.detections), (125.0, fifth), (25.0, none))
    ]
    assert len(chosen[0]) == 3 and chosen[0] == chosen[1] == chosen[2]
    without = replace(made, detections=none, joints=np.full_like(made.joints, np.nan))
    assert adjust_cameras(without, QUICK).used.size == 0


@pytest.mark.slow
def test_covariance_covers_the_error(clip):
    squared = []
    for seed in range(8):
        made, true, _ = clip(seed=seed, lasting=0.7)
        adjusted = adjust_cameras(made, QUICK)
        center = adjusted.cameras.center - true.center
        rotation = true.cam_from_world.rotation
        spread = rotation.swapaxes(1, 2) @ adjusted.covariance[:, 3:6, 3:6] @ rotation
        squared += [off @ np.linalg.solve(s, off) for off, s in zip(center, spread, strict=True)]
    # Chi-square with three degrees of freedom: 40 values have a mean of 3 +- 0.4 if they were
    # independent, and those of one trial share the world's place.
    assert 1.8 < np.mean(squared) < 4.5


def test_markings_alone_are_refused_where_they_bend_the_camera(clip):
    made, true, _ = clip(clicked=6, seed=2)
    rng, clustered = np.random.default_rng(5), []
    for c, clicks in enumerate(made.clicks):
        # All in a tenth of the pitch: the lens is free to do anything elsewhere.
        near = 0.3 * clicks.points_world + [14.0, 14.0, 0.0]
        pixels = true[c].project(near) + 1.5 * rng.standard_normal((6, 2))
        clustered.append(replace(clicks, points_world=near, points_image=pixels))
    made = replace(made, clicks=tuple(clustered))
    adjusted = adjust_cameras(made, QUICK.model_copy(update={"evidence": "markings"}))
    assert errors(adjusted.refused, true).max() > 2.0 * errors(made.cameras, true).max()
    assert not adjusted.accepted.any()
    np.testing.assert_array_equal(adjusted.cameras.numbers, made.cameras.numbers)
    np.testing.assert_array_equal(adjusted.covariance, made.covariance)
    assert all(reason.startswith("refused: the loss of") for reason in adjusted.reasons)


NOBODY = "no person has enough inlier cameras"


@pytest.mark.parametrize(
    ("size", "change", "evidence", "reason"),
    [
        ({"frames": 6}, lambda m: {"joints": np.full_like(m.joints, np.nan)}, "people", NOBODY),
        (
            {"frames": 6},
            lambda m: {n: getattr(m, n)[:0] for n in ("detections", "joints", "views")},
            *("people", NOBODY),
        ),
        ({"cameras": 1}, lambda _: {}, "people", NOBODY),
        ({"cameras": 2}, lambda _: {}, "people", NOBODY),
        (
            {"frames": 6},
            lambda m: {"clicks": (Clicks.none(),) * len(m.clicks)},
            *("markings", "no camera has a clicked marking"),
        ),
    ],
    ids=["nobody", "no frames", "one camera", "two cameras in line", "no markings"],
)
def test_what_tells_nothing_leaves_cameras_as_they_were_and_says_why(
    clip, size, change, evidence, reason
):
    made, *_ = clip(**size)
    settings = QUICK if evidence == "people" else QUICK.model_copy(update={"evidence": evidence})
    adjusted = adjust_cameras(replace(made, **change(made)), settings)
    assert not adjusted.accepted.any()
    np.testing.assert_array_equal(adjusted.cameras.numbers, made.cameras.numbers)
    assert all(reason in said for said in adjusted.reasons)


@pytest.mark.parametrize("evidence", ["markings_and_players", "markings"])
def test_the_papers_adjustment_finds_the_cameras_of_exact_markings_and_people(clip, evidence):
    pytest.importorskip("torch")
    made, true, _ = clip(noise=0.0, clicked=14)
    exact = tuple(
        replace(one, points_image=true[c].project(one.points_world))
        for c, one in enumerate(made.clicks)
    )
    made = replace(made, clicks=exact)
    settings, frames = BundleAdjustmentSettings(evidence=evidence), np.arange(8)
    found = adjust_unguarded(made, settings, frames, frames)
    assert found.accepted.all()
    np.testing.assert_allclose(found.cameras.center, true.center, atol=1e-3)
    tangential = replace(made.cameras, distortion=made.cameras.distortion + 0.001)
    with pytest.raises(InputError, match="tangential"):
        adjust_unguarded(replace(made, cameras=tangential), settings, frames, frames)


CASES = {
    "exact": ([0.0] * 3, [0.0] * 3, 1.0),
    "small": ([1e-4] * 3, [0.005] * 3, 1.0),
    "large": ([5e-3] * 3, [0.3] * 3, 1.0),
    "focal": ([0.0] * 3, [0.0] * 3, 1.1),
}
"""Errors about and along the axes [rad, m], and a factor of the focal length of camera 1."""


def given(clip, cameras, **changes):
    """The clip without clicks, with exact covariances of these cameras."""
    seen = changes.get("detections", clip.detections)
    placed = triangulate_joints(cameras, seen, clip.triangulation)
    return replace(
        clip,
        cameras=cameras,
        covariance=np.zeros_like(clip.covariance),
        clicks=(Clicks.none(),) * len(cameras.focal),
        joints=placed.joints,
        views=placed.views.astype(np.int64),
        **changes,
    )


@pytest.mark.parametrize(
    "case",
    [
        "exact",
        "large",
        *(pytest.param(case, marks=pytest.mark.slow) for case in ("small", "focal")),
    ],
)
def test_joints_are_never_worse_than_with_the_given_cameras(clip, case):
    made, true, joints = clip(cameras=4, frames=40, lasting=1.0, seed=3)
    turn, shift, focal = CASES[case]
    rng = np.random.default_rng(5)
    step = np.zeros((4, 12))
    step[:, :6] = np.array([*turn, *shift]) * rng.standard_normal((4, 6))
    step[1, 6] = np.log(focal)
    made = given(made, step_camera(true, step))
    adjusted = adjust_cameras(made)
    told = adjusted.covariance if adjusted.accepted.all() else None
    after = triangulate_joints(adjusted.cameras, made.detections, made.triangulation, told).joints
    before, after = (
        np.nanmean(np.linalg.norm(each - joints, axis=-1)) for each in (made.joints, after)
    )
    assert after < before + 0.001
    if case in ("exact", "small"):
        assert not adjusted.accepted.any()
        np.testing.assert_array_equal(adjusted.motion, 0.0)
        assert all(reason.startswith("refused") for reason in adjusted.reasons)
    else:
        assert after < 0.9 * before


def test_refused_given_cameras_do_not_pull_the_others(clip):
    made, true, _ = clip(cameras=8, frames=60, lasting=1.0, seed=1)
    # Two cameras err by 5 cm together, and have too few keypoints for a change.
    step = np.zeros((8, 12))
    scale = np.array([1e-3] * 3 + [0.1] * 3)
    step[:, :6] = scale * np.random.default_rng(2).standard_normal((8, 6))
    step[:2, 3:6] = true.cam_from_world.rotation[:2] @ [0.3, 0.0, 0.0]
    cameras = step_camera(true, step)
    confidence = made.detections.confidence.copy()
    confidence[:, :2, :, ::2] = 0.0
    seen = replace(made.detections, confidence=confidence)
    made = given(made, cameras, detections=seen)
    adjusted = adjust_cameras(made, BundleAdjustmentSettings(min_judges=1200))
    np.testing.assert_array_equal(adjusted.accepted, [False] * 2 + [True] * 6)
    np.testing.assert_array_equal(adjusted.cameras.numbers[:2], cameras.numbers[:2])
    others = seen.detection_index.copy()
    others[:, :2] = -1
    before, after = (
        triangulate_joints(each, seen.assign_people(others), made.triangulation).joints
        for each in (cameras, adjusted.cameras)
    )
    # No more than their share of eight cameras.
    assert np.linalg.norm(np.nanmean(after - before, axis=(0, 1, 2))) < 0.3 * 2 / 8


QUICK_CHECK = BundleAdjustmentSettings(max_frames=8, folds=2)
WRONG = 2


def placed_again(clip):
    """The clip with its people triangulated with the cameras that it has now."""
    detections = clip.detections
    placed = triangulate_joints(clip.cameras, detections, clip.triangulation)
    return replace(clip, joints=placed.joints, views=placed.views.astype(np.int64))


def test_well_calibrated_cameras_stay_unless_the_change_is_beyond_chance(clip):
    made, true, _ = clip(cameras=8, seed=3)
    exact = placed_again(replace(made, cameras=true, covariance=1e-4 * made.covariance))
    adjusted = adjust_cameras(exact, QUICK_CHECK)
    assert not adjusted.accepted.any()
    np.testing.assert_array_equal(adjusted.cameras.numbers, true.numbers)
    np.testing.assert_array_equal(adjusted.covariance, exact.covariance)
    # By chance the loss of some falls and that of others rises.
    falls = adjusted.verdict.loss[:, 1] < adjusted.verdict.loss[:, 0]
    assert falls.any()
    assert all("standard errors" in adjusted.reasons[c] for c in np.flatnonzero(falls))
    assert adjusted.evidence.shift > 0.0  # that of the proposed change


def test_a_camera_calibrated_wrong_is_mended_and_the_others_hardly_feel_it(clip):
    made, true, _ = clip(cameras=8, seed=3)
    # Calibrations of one or two pixels, not of ten: three views or more agree about every joint.
    covariance = 0.02 * made.covariance
    spread = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    step = spread * np.random.default_rng(7).standard_normal((8, 12))
    made = replace(made, cameras=step_camera(true, step), covariance=covariance)
    step = np.zeros((8, 12))
    step[WRONG, 1] = 0.02  # 40 px, two hundred times what its calibration states
    wrong = replace(made, cameras=step_camera(made.cameras, step))
    honest, mended = (adjust_cameras(placed_again(each), QUICK_CHECK) for each in (made, wrong))
    assert honest.accepted.all() and mended.accepted.all()
    clean, left = (errors(each.cameras, true) for each in (honest, mended))
    # It had a say in where the world is: without it the others lose an eighth of their knowledge.
    assert np.delete(left, WRONG).mean() < 1.25 * np.delete(clean, WRONG).mean()
    # A hundredth of what it was, and more than the others': people alone place it.
    assert left[WRONG] < 0.4


def test_true_cameras_are_judged_by_the_noise_alone(clip):
    made, true, _ = clip(cameras=6, noise=1.0)
    frames = np.arange(24)
    held = held_out_errors(made, true, frames, np.ones((24, 6), dtype=bool), robust_scale=100.0)
    # Two axes of unit variance, and what the joint of five other views adds: 2 (1 + 3 / (2 x 5)).
    assert np.nanmean(held.loss) == pytest.approx(2.6, rel=0.05)
