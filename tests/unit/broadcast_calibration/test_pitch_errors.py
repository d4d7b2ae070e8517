"""A pitch without survey: its crown, its paint, and errors that last for the whole clip."""

from dataclasses import replace

import numpy as np
import pytest
import turning_clip as clip

from data_contracts.pitch import PitchSpec
from worldpose.broadcast_calibration.evidence import MARKING, FlowEvidence, spread_noise
from worldpose.broadcast_calibration.pitch_errors import PitchErrors
from worldpose.broadcast_calibration.priors import build_prior
from worldpose.broadcast_calibration.settings import BroadcastCalibrationSettings, BroadcastPrior
from worldpose.broadcast_calibration.solver import Problem, displace, solve
from worldpose.broadcast_calibration.uncertainty import lasting_samples, paint_variance
from worldpose.pitch.template import PitchTemplate

SETTINGS = BroadcastCalibrationSettings()


def pitch(**known):
    return PitchTemplate.from_spec(PitchSpec(**known))


def test_only_what_nobody_measured_has_an_error():
    usual = PitchErrors.of(pitch(), SETTINGS)
    np.testing.assert_allclose(usual.size_m, [0.1, 0.1, 0.1, 0.1])
    assert (usual.point_m == 0.03).all()
    given = PitchErrors.of(pitch(length=104.0, crown=0.12), SETTINGS)
    np.testing.assert_allclose(given.size_m, [0.0, 0.1, 0.0, 0.1])
    corner = {"corner_left_near": (-52.51, -34.02, -0.19)}
    surveyed = PitchErrors.of(pitch(points=corner), SETTINGS)
    assert not surveyed.size_m.any()
    names = list(pitch().points)
    assert surveyed.point_m[names.index("corner_left_near")] == SETTINGS.survey_error_m
    assert surveyed.point_m[names.index("center_mark")] == 0.03


def test_a_larger_pitch_moves_corners_and_a_fall_lowers_touch_lines_and_ends():
    errors, names = PitchErrors.of(pitch(), SETTINGS), list(pitch().points)
    ends = np.array([[names.index(name), -1] for name in ("corner_right_near", "center_mark")])
    world = pitch().positions(["corner_right_near", "center_mark"])
    moved = errors.displacement_by_size(ends, np.ones(ends.shape), world)
    np.testing.assert_allclose(moved[0], [[0.05, -0.05, -0.1], [0.0, 0.0, -0.1]], atol=1e-12)
    np.testing.assert_allclose(moved[1], 0.0, atol=1e-12)


def fallen_clip(rng, crown, end_fall):
    """Points of a pitch with another surface than the template's, and a camera at the truth."""
    true = clip.moving(20, pan=(-12.0, 15.0))
    points = clip.ground_points(true, rng, each=60)
    place, truth = points.world, pitch(crown=crown, end_fall=end_fall)
    moved = np.stack([place[:, 0], place[:, 1], truth.height(place[:, 0], place[:, 1])], axis=-1)
    image = np.empty_like(points.image)
    for frame in range(len(true)):
        mine = points.frame == frame
        image[mine] = true.camera[frame].project(moved[mine])
    image += 0.3 * rng.standard_normal(image.shape)
    errors = PitchErrors.of(pitch(), SETTINGS)
    nothing = np.full((len(points), 2), -1)
    by_size = errors.displacement_by_size(nothing, np.ones(nothing.shape), place)
    return true, replace(points, image=image, by_size=by_size), errors


def test_the_surface_is_found_within_what_is_stated():
    off = []
    for seed in range(4):
        true, points, errors = fallen_clip(np.random.default_rng(seed), 0.05, 0.4)
        problem = Problem(
            points,
            FlowEvidence.none(),
            build_prior(BroadcastPrior(), true.focal, true.image_size),
        )
        solution = solve(true, problem, 30)
        assert problem.size_row == 0
        shape = [0.2, 0.0] + (errors.size_m * problem.of_size(solution.paint_offsets))[2:]
        std = (errors.size_m * np.sqrt(problem.of_size(paint_variance(solution))))[2:]
        assert (std < 0.05).all()
        off.append((shape - [0.05, 0.4]) / std)
        shifted = displace(problem.points, problem, solution.paint_offsets)
        assert (
            np.abs(
                shifted.world[:, 2] - pitch().with_surface(shape).height(*points.world[:, :2].T)
            ).max()
            < 1e-9
        )
    assert np.sqrt(np.mean(np.square(off))) < 2.0


def test_errors_that_last_count_as_one_sample():
    rng = np.random.default_rng(1)
    points = clip.ground_points(clip.moving(20), rng, each=60)
    assert (points.kind == MARKING).all()
    alone = points.whitening[:, 0] / (points.whitening[:, 0] ** 2).sum(-1, keepdims=True)
    independent = alone * rng.standard_normal((len(points), 1))
    assert lasting_samples(points, independent) == pytest.approx(1.0, abs=0.4)
    assert lasting_samples(points, alone) > 4.0
    spread = spread_noise(points, 4.0)
    np.testing.assert_allclose(spread.whitening, 0.5 * points.whitening)
    np.testing.assert_allclose(spread.loss, 0.5 * points.loss)
