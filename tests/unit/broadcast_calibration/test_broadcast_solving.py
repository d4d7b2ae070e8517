"""The solver of all frames at once: known truth, SciPy, and what is held fixed."""

from dataclasses import replace

import numpy as np
import pytest
import turning_clip as clip
from scipy.optimize import least_squares

from worldpose.broadcast_calibration.adam import descend
from worldpose.broadcast_calibration.evidence import FlowEvidence, PointEvidence
from worldpose.broadcast_calibration.priors import prior_of
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.solving import Problem, solve
from worldpose.broadcast_calibration.uncertainty import uncertainty_of
from worldpose.errors import DegenerateError

SMOOTH = np.array([np.inf] * 3 + [1e-4, 1e-3, 1e-2, 1e-2])


def problem_of(true, rng, frames=None, noise=0.3, smooth=SMOOTH):
    points = clip.ground_points(true, rng, noise=noise)
    if frames is not None:
        points = points[np.isin(points.frame, frames)]
    prior = prior_of(BroadcastPrior(), true.focal, true.image_size)
    return Problem(points, clip.followed_points(true, rng), prior, smooth, 1.0, np.inf)


def off(true, rng):
    step = 1e-3 * rng.standard_normal((len(true), 7))
    step[:, 3] *= 5.0
    return true.stepped(step, [0.4, -0.5, 0.3, 3.0, 2.0])


def bearing_error(camera, true):
    pixels = np.array([[100.0, 100.0], [480.0, 270.0], [860.0, 440.0]])
    one, two = (each.camera.unproject(pixels).directions for each in (camera, true))
    return np.degrees(np.linalg.norm(one - two, axis=-1))


def test_exact_evidence_gives_the_exact_camera():
    rng = np.random.default_rng(1)
    true = clip.moving(20)
    problem = problem_of(true, rng, noise=1e-6, smooth=np.full(7, np.inf))
    problem = replace(problem, flow=FlowEvidence.none())
    found = solve(off(true, rng), problem, 60).camera
    # A prior of pixels beside evidence of 1e-6 px.
    np.testing.assert_allclose(found.center, true.center, atol=1e-3)
    assert np.median(bearing_error(found, true)) < 1e-5


def test_noisy_evidence_gives_the_camera_within_its_covariance():
    true = clip.moving(30)
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        problem = problem_of(true, rng)
        solution = solve(off(true, rng), problem, 40)
        covariance = uncertainty_of(solution, problem).clip[:3, :3]
        gone = solution.camera.center - true.center
        ratios.append(gone @ np.linalg.solve(covariance, gone) / 3.0)
    # Chi-square of 18 over 18 lies below 2.2 in all but a thousandth; the covariance is at most
    # twice too wide.
    assert 0.05 < np.mean(ratios) < 2.2


def test_scipy_finds_no_lower_cost():
    rng = np.random.default_rng(3)
    true = clip.moving(5)
    problem = replace(problem_of(true, rng), smoothness=np.full(7, np.inf), flow_weight=0.0)
    start = off(true, rng)
    found = solve(start, problem, 60)
    points, prior = problem.points, problem.prior

    def residuals(x):
        camera = start.stepped(x[:35].reshape(5, 7), x[35:40])
        pixels = np.empty_like(points.image)
        for frame in range(5):
            mine = points.frame == frame
            pixels[mine] = camera.camera[frame].project(points.world[mine])
        white = np.einsum("nij,nj->ni", points.whitening, pixels - points.image)[:, 0]
        lens = (camera.distortion - prior.distortion) / prior.distortion_spread
        zoom = (np.log(camera.focal) - prior.log_focal) / prior.focal_spread
        place = np.sqrt(np.diag(prior.center_information)) * (camera.center - prior.center)
        middle = (camera.principal_point - prior.principal_point) / prior.principal_spread
        return np.concatenate([white, lens.ravel(), zoom, place, middle])

    peer = least_squares(residuals, np.zeros(40), x_scale="jac", xtol=1e-12, ftol=1e-12)
    # Both end within a relative 1e-7 of a minimum.
    assert found.cost <= peer.cost * (1.0 + 1e-6)


def test_frames_without_points_are_carried_by_followed_ones():
    rng = np.random.default_rng(5)
    true = clip.moving(40)
    problem = problem_of(true, rng, frames=np.r_[0:5, 35:40])
    start = off(true, rng)
    found = solve(start, problem, 60).camera
    # 60 points of 0.1 px a pair: a thousandth of a degree a frame, twenty from either end.
    assert np.median(bearing_error(start, true)[5:35]) > 0.05
    assert np.median(bearing_error(found, true)[5:35]) < 0.02


def test_smoothness_makes_focal_lengths_even_at_the_same_residuals():
    rng = np.random.default_rng(6)
    true = clip.moving(60, zoom=(2000.0, 2030.0))
    problem = problem_of(true, rng, smooth=np.array([np.inf] * 3 + [2e-5, 1e-4, 1e-3, 1e-3]))
    rough = solve(off(true, rng), replace(problem, smoothness=np.full(7, np.inf)), 60)
    even = solve(off(true, rng), problem, 60)
    bends = [np.std(np.diff(np.log(each.camera.focal), n=2)) for each in (rough, even)]
    # The true change is 1e-5 a frame squared; single frames know the focal length to 1e-4.
    assert bends[1] < bends[0] / 3.0
    assert np.median(bearing_error(even.camera, true)) < np.median(
        bearing_error(rough.camera, true)
    )


def test_what_is_not_solved_for_stays():
    rng = np.random.default_rng(7)
    true = clip.moving(10)
    problem = replace(
        problem_of(true, rng),
        free_frame=np.arange(7) < 3,
        free_clip=np.zeros(5, dtype=np.bool_),
        smoothness=np.full(7, np.inf),
    )
    start = true.stepped(1e-3 * rng.standard_normal((10, 7)) * (np.arange(7) < 3), np.zeros(5))
    found = solve(start, problem, 30).camera
    np.testing.assert_array_equal(found.focal, start.focal)
    np.testing.assert_array_equal(found.center, start.center)
    assert bearing_error(found, true).mean() < bearing_error(start, true).mean() / 5.0


def test_adam_goes_down_the_same_cost_and_stays_above():
    rng = np.random.default_rng(8)
    true = clip.moving(10)
    problem = problem_of(true, rng)
    start = off(true, rng)
    best, slow = solve(start, problem, 40), descend(start, problem, 200)
    assert best.cost < slow.cost < slow.costs[0]


def test_a_frame_with_neither_evidence_nor_prior_is_named_as_undetermined():
    true = clip.moving(4)
    prior = prior_of(BroadcastPrior(), true.focal, true.image_size)
    with pytest.raises(DegenerateError, match="neither evidence nor prior"):
        solve(true, Problem(PointEvidence.none(), FlowEvidence.none(), prior), 5)
