"""The solver of all frames at once: known truth, SciPy, and what is held fixed."""

from dataclasses import replace

import numpy as np
import pytest
import turning_clip as clip
from scipy.optimize import least_squares

from worldpose.broadcast_calibration.evidence import (
    FlowEvidence,
    PointEvidence,
)
from worldpose.broadcast_calibration.normal_equations import point_row
from worldpose.broadcast_calibration.priors import build_prior
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.solver import Problem, descend, solve
from worldpose.broadcast_calibration.uncertainty import compute_uncertainty
from worldpose.errors import DegenerateError

SMOOTH = np.array([np.inf] * 3 + [1e-4, 1e-3, 1e-2, 1e-2])


def problem_of(true, rng, frames=None, noise=0.3, smooth=SMOOTH):
    points = clip.ground_points(true, rng, noise=noise)
    if frames is not None:
        points = points[np.isin(points.frame, frames)]
    prior = build_prior(BroadcastPrior(), true.focal, true.image_size)
    return Problem(points, clip.followed_points(true, rng), prior, smooth, 1.0, np.inf)


def off(true, rng):
    step = 1e-3 * rng.standard_normal((len(true), 7))
    step[:, 3] *= 5.0
    return true.take_step(step, [0.4, -0.5, 0.3, 3.0, 2.0])


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
    # A prior of pixels against evidence of 1e-6 px.
    np.testing.assert_allclose(found.center, true.center, atol=1e-3)
    assert np.median(bearing_error(found, true)) < 1e-5


def place_covariance(camera, uncertainty, place, frame=10):
    """Covariance of a place in one frame's image [px^2]."""
    pixel, rows = np.empty(2), np.empty((2, 12))
    point_row(camera.rotation[frame], camera.center, camera.lens(frame), place, pixel, rows)
    return rows @ uncertainty.frame[frame] @ rows.T


def test_a_shift_of_all_lines_moves_what_the_camera_shows_by_as_much():
    rng = np.random.default_rng(10)
    true = clip.moving(20)
    problem = replace(problem_of(true, rng), flow=FlowEvidence.none())
    solution = solve(true, problem, 20)
    place = np.array([1.0, -3.0, 0.0])
    exact, shifted = (
        place_covariance(solution.camera, compute_uncertainty(solution, problem, shift), place)
        for shift in (0.0, 0.2)
    )
    # The camera goes along with its lines; priors hold it back by some percent.
    np.testing.assert_allclose(shifted - exact, 0.04 * np.eye(2), atol=0.004)


def test_scipy_finds_no_lower_cost():
    rng = np.random.default_rng(3)
    true = clip.moving(5)
    problem = replace(problem_of(true, rng), smoothness=np.full(7, np.inf), flow_weight=0.0)
    start = off(true, rng)
    found = solve(start, problem, 60)
    points, prior = problem.points, problem.prior

    def residuals(x):
        camera = start.take_step(x[:35].reshape(5, 7), x[35:40])
        pixels = np.empty_like(points.image)
        for frame in range(5):
            mine = points.frame == frame
            pixels[mine] = camera.camera[frame].project(points.world[mine])
        white = np.einsum("nij,nj->ni", points.whitening, pixels - points.image)[:, 0]
        lens = (camera.distortion - prior.distortion) / prior.distortion_std
        zoom = (np.log(camera.focal) - prior.log_focal) / prior.log_focal_std
        place = np.sqrt(np.diag(prior.center_information)) * (camera.center - prior.center)
        middle = (camera.principal_point - prior.principal_point) / prior.principal_std
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
    # 60 points of 0.1 px per pair: a thousandth of a degree per frame, twenty from either end.
    assert np.median(bearing_error(start, true)[5:35]) > 0.05
    assert np.median(bearing_error(found, true)[5:35]) < 0.02


def test_what_is_held_is_known_exactly_and_the_rest_within_its_covariance():
    true = clip.moving(12)
    known = np.zeros((12, 7), dtype=np.bool_)
    known[0] = True
    held = known | (np.arange(7) >= 3)
    place, ratios = np.array([1.0, -3.0, 0.0]), []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        problem = replace(
            problem_of(true, rng, smooth=np.full(7, np.inf)),
            free_frame=np.arange(7) < 3,
            free_clip=np.zeros(5, dtype=np.bool_),
            known=known,
        )
        solution = solve(
            true.take_step(1e-3 * rng.standard_normal((12, 7)) * ~held, np.zeros(5)), problem, 30
        )
        uncertainty = compute_uncertainty(solution, problem)
        variance = np.diagonal(uncertainty.frame, axis1=1, axis2=2)
        np.testing.assert_array_equal(
            variance == 0.0, np.pad(held, ((0, 0), (0, 5)), constant_values=True)
        )
        assert not place_covariance(solution.camera, uncertainty, place, 0).any()
        covariance = place_covariance(solution.camera, uncertainty, place)
        gone = solution.camera.camera[10].project(place[None]) - true.camera[10].project(
            place[None]
        )
        ratios.append(float(gone[0] @ np.linalg.solve(covariance, gone[0])) / 2.0)
    # Too wide by two here as well; chi-square of 60 over 60 lies between 0.53 and 1.66 in all but
    # a thousandth on either side.
    assert 0.26 < np.mean(ratios) < 0.83


def test_adam_goes_down_the_same_cost_and_stays_above():
    rng = np.random.default_rng(8)
    true = clip.moving(10)
    problem = problem_of(true, rng)
    start = off(true, rng)
    best, slow = solve(start, problem, 40), descend(start, problem, 200)
    assert best.cost < slow.cost < slow.costs[0]


def test_a_frame_with_neither_evidence_nor_prior_is_named_as_undetermined():
    true = clip.moving(4)
    prior = build_prior(BroadcastPrior(), true.focal, true.image_size)
    with pytest.raises(DegenerateError, match="neither evidence nor prior"):
        solve(true, Problem(PointEvidence.none(), FlowEvidence.none(), prior), 5)
