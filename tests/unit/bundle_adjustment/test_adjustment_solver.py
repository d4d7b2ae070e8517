"""Cameras and points adjusted together, against known truth."""

from dataclasses import replace

import numpy as np
import pytest

from worldpose.bundle_adjustment.solver import solve
from worldpose.errors import InputError, InternalError
from worldpose.static_calibration.parameters import PARAMETERS, step_camera

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


def test_nothing_fixes_the_scene_is_refused(scene):
    problem, *_ = scene(markings=0)
    with pytest.raises(InputError, match="hold in place"):
        solve(disturbed(problem))


def test_one_camera_alone_cannot_place_points(scene):
    problem, *_ = scene()
    alone = keep(
        problem,
        problem.camera_of == 0,
        cameras=problem.cameras[:1],
        free=problem.free[:1],
        camera_information=problem.camera_information[:1],
    )
    with pytest.raises(InputError, match="two cameras"):
        solve(alone)


def test_a_point_behind_its_camera_is_refused(scene):
    problem, *_ = scene()
    points = problem.points.copy()
    points[-1] = 2.0 * problem.cameras.center[0] - points[-1]
    with pytest.raises(InputError, match="in front"):
        solve(replace(problem, points=points))


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


def test_a_camera_that_nothing_holds_is_named(scene):
    problem, *_ = scene(joints=0)
    names = ("north", "east", "south", "west")
    lone = keep(problem, problem.camera_of != 2)
    with pytest.raises(InputError, match="that number 2 can move"):
        solve(lone)
    with pytest.raises(InputError, match="that south can move"):
        solve(replace(lone, names=names))


def test_numbers_that_are_not_finite_are_no_fault_of_the_cameras(scene):
    problem, *_ = scene()
    information = problem.camera_information.copy()
    information[1] = np.nan
    with pytest.raises(InternalError, match="no number"):
        solve(replace(problem, camera_information=information))
