"""The solver of bundle adjustment: its derivatives, its answers on known scenes, and its report."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import rig

from worldpose.bundle_adjustment.report import keypoint_outliers, review_clicks
from worldpose.bundle_adjustment.residuals import KeypointNoise
from worldpose.bundle_adjustment.solver import solve
from worldpose.bundle_adjustment.uncertainty import relative_covariance, similarity_steps
from worldpose.errors import InputError, InternalError
from worldpose.geometry.camera_model import STEP
from worldpose.geometry.optimize.schur_complement import (
    CameraEquations,
    PointObservations,
    cost,
    eliminate,
)
from worldpose.static_calibration.parameters import PARAMETERS, project_with_jacobian, step_camera

DISTURBED = np.array([2e-3, 2e-3, 2e-3, 0.1, 0.1, 0.1, 5e-3, 3.0, 3.0, 0.01, 0.005, 0.0])


def disturbed(problem, seed=7):
    rng = np.random.default_rng(seed)
    step = DISTURBED * rng.standard_normal((len(problem.free), len(PARAMETERS)))
    free = np.where(np.isinf(problem.point_information), 0.0, 0.1)[:, None]
    points = problem.points + free * rng.standard_normal(problem.points.shape)
    return replace(problem, cameras=step_camera(problem.cameras, step), points=points)


def keep(problem, kept, **changes):
    """The problem with some of its observations (n,), and further changes."""
    rows = ("point_of", "camera_of", "image", "weight", "scale")
    return replace(problem, **{name: getattr(problem, name)[kept] for name in rows}, **changes)


def only_the_first(problem):
    changes = {name: getattr(problem, name)[:1] for name in ("cameras", "free")}
    changes["camera_information"] = problem.camera_information[:1]
    return keep(problem, problem.camera_of == 0, **changes)


def last_behind(problem):
    points = problem.points.copy()
    points[-1] = 2.0 * problem.cameras.center[0] - points[-1]
    return replace(problem, points=points)


def without_the_third(problem):
    return keep(problem, problem.camera_of != 2)


NAMES = ("north", "east", "south", "west")


@pytest.mark.parametrize(
    ("made", "change", "told"),
    [
        ({"markings": 0}, disturbed, "hold in place"),
        ({}, only_the_first, "two cameras"),
        ({}, last_behind, "in front"),
        ({"joints": 0}, without_the_third, "that number 2 can move"),
        ({"joints": 0}, lambda one: replace(without_the_third(one), names=NAMES), "that south can"),
    ],
)
def test_a_scene_that_is_not_determined_is_refused_with_the_reason(scene, made, change, told):
    with pytest.raises(InputError, match=told):
        solve(change(scene(**made)[0]))


def test_exact_observations_give_back_the_truth(scene):
    problem, true, points = scene(joints=60)
    adjust = solve(disturbed(problem))
    assert adjust.converged
    # 1e-8 of the cost at the start is left: far below a hundredth of a pixel.
    np.testing.assert_allclose(adjust.points, points, atol=1e-5)
    np.testing.assert_allclose(adjust.cameras.center, true.center, atol=1e-4)
    np.testing.assert_allclose(adjust.cameras.focal, true.focal, rtol=1e-6)


def test_a_wrong_observation_hardly_counts_with_a_robust_loss(scene):
    problem, _, points = scene(noise=0.5, joints=60, seen=1.0)
    image = problem.image.copy()
    image[np.flatnonzero(problem.point_of >= 24)[::25]] += 80.0
    start = disturbed(problem)

    def error(**changes):
        return np.linalg.norm(solve(replace(start, **changes)).points - points, axis=1).mean()

    clean = error()
    assert error(image=image) > 5.0 * clean
    # Cauchy's loss at three standard deviations costs a few per cent of efficiency.
    assert error(image=image, scale=np.full(len(image), 3.0)) < 1.5 * clean


def test_covariance_of_the_cameras_is_what_repetition_shows(scene):
    errors, covariance = [], None
    for seed in range(60):
        problem, true, _ = scene(noise=1.0, seed=1)
        rng = np.random.default_rng(100 + seed)
        exact, *_ = scene(noise=0.0, seed=1)
        noisy = replace(problem, image=exact.image + rng.standard_normal(exact.image.shape))
        adjust = solve(noisy)
        errors.append(adjust.cameras.center[0] - true.center[0])
        covariance = adjust.camera_covariance
    rotation = true.cam_from_world.rotation[0]
    # A shift t in the camera's axes moves the center by -R^T t.
    stated = rotation.T @ covariance[3:6, 3:6] @ rotation
    # 60 repetitions tell a standard deviation to 9 %; three of them.
    np.testing.assert_allclose(np.std(errors, axis=0), np.sqrt(np.diag(stated)), rtol=0.28)


def test_numbers_that_are_not_finite_are_no_fault_of_the_cameras(scene):
    problem, *_ = scene()
    information = problem.camera_information.copy()
    information[1] = np.nan
    with pytest.raises(InternalError, match="no number"):
        solve(replace(problem, camera_information=information))


ORIGIN = np.array([0.3, -0.2, 1.0])


@pytest.mark.parametrize("scale", [np.inf, 2.0])
def test_the_gradient_is_the_slope_of_the_cost(scene, scale):
    problem, _, points = scene(noise=3.0)
    problem = replace(problem, scale=np.full(len(problem.image), scale))
    first_of = np.searchsorted(problem.point_of, np.arange(len(problem.points) + 1))
    evidence = PointObservations(
        *(problem.points, problem.point_information, first_of, problem.camera_of),
        *(problem.image, problem.weight, problem.scale),
    )
    numbers = problem.cameras.numbers
    rows, columns = np.zeros((3 * len(points), 1)), np.full((4, STEP), -1)
    blocks, gradient = np.zeros((4, STEP, STEP)), np.zeros((4, STEP))
    equations = CameraEquations(columns, rows, blocks, gradient)
    eliminate(numbers, points, evidence, 0.0, 0, len(points), equations)
    for parameter in range(STEP):
        step = np.zeros((4, STEP))
        step[1, parameter] = 1e-6
        high = cost(step_camera(problem.cameras, step).numbers, points, evidence)
        low = cost(step_camera(problem.cameras, -step).numbers, points, evidence)
        # The cost is the sum of squares, the gradient that of half of it.
        slope = 0.5 * (high - low) / 2e-6
        assert slope == pytest.approx(gradient[1, parameter], rel=1e-4, abs=1e-2)


@pytest.fixture
def rng():
    return np.random.default_rng(8)


@pytest.mark.parametrize("parameter", range(7))
def test_steps_are_the_derivatives_of_cameras_that_follow(rng, parameter):
    cameras, points = rig(3, rng), rng.normal(0.0, 0.5, (10, 3))
    small = np.zeros(7)
    small[parameter] = 1e-6
    away = points - ORIGIN
    moved = points + small[:3] + np.cross(small[3:6], away) + small[6] * away
    seen = step_camera(cameras, similarity_steps(cameras, ORIGIN) @ small).project(moved)
    # A thousand pixels times the square of the step are left.
    np.testing.assert_allclose(seen, cameras.project(points), atol=1e-8)


def test_what_cameras_err_by_in_common_is_taken_apart(rng):
    cameras, points = rig(4, rng), rng.normal(0.0, 0.5, (40, 3)) + ORIGIN
    by_step = np.stack([project_with_jacobian(camera, points)[1] for camera in cameras])
    information = np.einsum("cnai,cnaj->cij", by_step, by_step)
    steps = similarity_steps(cameras, ORIGIN).reshape(48, 7)
    common = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03, 0.005]) ** 2
    own = np.zeros(48)
    relative, together = relative_covariance(
        steps @ common @ steps.T + np.diag(own), cameras, information, ORIGIN
    )
    np.testing.assert_allclose(together, common, atol=1e-10)
    np.testing.assert_allclose(relative, 0.0, atol=1e-10)
    # Independent errors of a millimetre: three of four quarters are relative.
    own.reshape(4, 12)[:, 3:6] = 1e-6
    relative, _ = relative_covariance(np.diag(own), cameras, information, ORIGIN)
    share = np.einsum("cii->c", relative[:, 3:6, 3:6]) / 3e-6
    assert (share > 0.1).all()
    assert (share < 1.0).all()


def test_planted_keypoints_come_first(clip):
    made, true, _ = clip(cameras=8, frames=20, noise=0.9)
    rng = np.random.default_rng(8)
    image = made.detections.keypoints.copy()
    chosen = rng.permutation(20 * 8 * 6 * 17)[:300]
    rows = np.column_stack(np.unravel_index(chosen, (20, 8, 6, 17)))
    planted = {tuple(row) for row in rows.tolist()}
    for row in sorted(planted):
        angle, length = rng.uniform(0.0, 2.0 * np.pi), 0.9 * rng.uniform(4.0, 30.0)
        image[row] += length * np.array([np.cos(angle), np.sin(angle)])
    spoiled = replace(made, detections=replace(made.detections, keypoints=image))
    listed = keypoint_outliers(spoiled, true, KeypointNoise(), 4.2, 10_000)
    first = list(zip(listed.frame, listed.camera, listed.person, listed.joint, strict=True))
    assert (np.diff(listed.surprise) <= 0).all()
    hits = planted & set(first[: len(planted)])
    # Errors of 4 to 30 standard deviations, give or take the keypoint's own, among 16,320.
    assert len(hits) >= 0.95 * len(planted)


@pytest.mark.parametrize(
    ("rests", "noise", "variance", "surprise"),
    # 12 px across and 9 px down; across the camera has a variance of its own.
    [
        (True, 1.0, 0.36, np.hypot(12.0 / 0.8, 9.0)),
        (False, 1.0, 0.36, np.hypot(12.0 / np.sqrt(1.36), 9.0)),
        # The clicks of a camera are as noisy as its calibration found, and so is its covariance.
        (True, 2.6, 4.0, np.hypot(12.0 / np.sqrt(2.76), 9.0 / 2.6)),
        # A click that alone determines the camera across is not tested there.
        (True, 1.0, 0.999, 9.0),
        (True, 1.0, 1.5, 9.0),
    ],
)
def test_a_wrong_click_is_more_surprising_than_honest_ones(clip, rests, noise, variance, surprise):
    made, true, _ = clip()
    clicks = made.clicks[2]
    image, inlier = clicks.points_image.copy(), clicks.inlier.copy()
    image[4] = true[2].project(clicks.points_world[4:5])[0] + [12.0, -9.0]
    inlier[4] = rests
    changed = replace(clicks, points_image=image, inlier=inlier, noise_px=noise)
    all_clicks = (*made.clicks[:2], changed, *made.clicks[3:])
    covariance = np.zeros_like(made.covariance)
    covariance[2, PARAMETERS.index("cx"), PARAMETERS.index("cx")] = variance
    review = review_clicks(all_clicks, true, covariance, np.ones(5, dtype=bool))
    assert (review.camera[0], review.name[0]) == (2, "point_4")
    np.testing.assert_allclose(review.residual[0], [-12.0, 9.0], atol=1e-9)
    assert review.surprise[0] == pytest.approx(surprise, rel=1e-9)
    assert review.surprise[1] < 4.2


def test_clicks_of_a_camera_that_did_not_change_are_judged_by_its_calibration(clip):
    made, *_ = clip()
    calibrated = [replace(clicks, surprise=np.arange(12.0)) for clicks in made.clicks]
    changed = np.array([True, True, False, True, True])
    review = review_clicks(tuple(calibrated), made.cameras, made.covariance, changed)
    own = review.camera == 2
    assert review.surprise[own].tolist() == np.arange(12.0)[::-1].tolist()
    assert np.array(review.name)[own].tolist() == [f"point_{k}" for k in range(11, -1, -1)]


@pytest.mark.parametrize(
    ("seen_at", "problem"),
    [
        ([0.0, 0.0, -30.0], "behind the camera"),
        ([70.0, 0.0, 10.0], "outside the lens's field of view"),
    ],
)
def test_a_click_on_a_point_that_the_camera_cannot_image_is_first_and_says_why(
    clip, seen_at, problem
):
    made, true, _ = clip()
    # A lens that folds at twice the focal length.
    true = replace(true, distortion=np.array([[-0.08, 0.0, 0.0, 0.0, 0.0]] * 5))
    clicks = made.clicks[2]
    place = true[2].cam_from_world.inverse().apply(np.array([seen_at]))
    changed = replace(
        clicks,
        names=(*clicks.names, "impossible"),
        points_world=np.concatenate([clicks.points_world, place]),
        points_image=np.concatenate([clicks.points_image, [[960.0, 540.0]]]),
        inlier=np.append(clicks.inlier, False),
        surprise=np.append(clicks.surprise, np.inf),
    )
    all_clicks = (*made.clicks[:2], changed, *made.clicks[3:])
    review = review_clicks(all_clicks, true, made.covariance, np.ones(5, dtype=bool))
    assert (review.camera[0], review.name[0]) == (2, "impossible")
    assert np.isnan(review.residual[0]).all() and np.isfinite(review.residual[1:]).all()
    assert review.surprise[0] == np.inf
    assert problem in review.problem[0] and not any(review.problem[1:])
