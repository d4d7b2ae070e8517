"""The solver of all frames at once: known truth, SciPy, and what is held fixed."""

from dataclasses import replace

import numpy as np
import pytest
import turning_clip as clip

from worldpose.broadcast_calibration.clip_problem import ClipProblem, TermWeights
from worldpose.broadcast_calibration.evidence import FlowEvidence, PointEvidence
from worldpose.broadcast_calibration.priors import build_prior
from worldpose.broadcast_calibration.residuals import linearize
from worldpose.broadcast_calibration.settings import BroadcastPrior
from worldpose.broadcast_calibration.solver import solve
from worldpose.errors import DegenerateError

SMOOTH = np.array([np.inf] * 3 + [1e-4])


def problem_of(true, rng, frames=None, noise=0.3, smooth=SMOOTH):
    points = clip.ground_points(true, rng, noise=noise)
    if frames is not None:
        points = points[np.isin(points.frame, frames)]
    prior = build_prior(BroadcastPrior(), true.focal, true.image_size)
    return ClipProblem(points, clip.followed_points(true, rng), prior, smoothness=smooth)


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
    problem = problem_of(true, rng, noise=1e-6, smooth=np.full(4, np.inf))
    problem = replace(problem, flow=FlowEvidence.none())
    found = solve(off(true, rng), problem, 60).camera
    # A prior of pixels against evidence of 1e-6 px.
    np.testing.assert_allclose(found.center, true.center, atol=1e-3)
    assert np.median(bearing_error(found, true)) < 1e-5


def test_a_frame_with_neither_evidence_nor_prior_is_named_as_undetermined():
    true = clip.moving(4)
    prior = build_prior(BroadcastPrior(), true.focal, true.image_size)
    with pytest.raises(DegenerateError, match="neither evidence nor prior"):
        solve(true, ClipProblem(PointEvidence.none(), FlowEvidence.none(), prior), 5)


def test_the_gradient_is_the_slope_of_the_cost():
    rng = np.random.default_rng(4)
    true = clip.moving(6)
    points, flow = clip.ground_points(true, rng, each=8), clip.followed_points(true, rng, each=8)
    # On nothing, one point, two points, or one twice, as arcs do.
    ends = rng.integers(-1, 4, (len(points), 2))
    shares = 0.01 * rng.uniform(0.2, 1.0, ends.shape)
    by_size = 0.01 * rng.standard_normal((len(points), 2, 3))
    by_size[:, 1, :2] = 0.0  # the end fall moves places along z alone
    known = {"ends": ends, "shares": shares, "by_size": by_size}
    robust = replace(points, loss=np.full(len(points), 3.0), **known)
    problem = ClipProblem(
        robust,
        flow,
        replace(
            build_prior(BroadcastPrior(), true.focal, true.image_size),
            rotation=true.rotation,
            rotation_std=np.array([np.inf, *[2e-3] * 5]),
        ),
        TermWeights(field=1.3, player=0.4, flow=0.7),
        smoothness=np.array([np.inf] * 3 + [1e-3]),
        lens_walk=np.linspace(0.1, 0.3, 5),
        flow_loss=2.0,
    )
    camera = true.take_step(1e-4 * rng.standard_normal((6, 7)), [0.02, -0.01, 0.03, 0.5, -0.4])
    beside = 0.3 * rng.standard_normal((problem.paint_count, 3))
    here = linearize(camera, beside, problem)
    step, shared = rng.standard_normal((6, 7)), rng.standard_normal(5)
    paint = rng.standard_normal(beside.shape)
    size = 1e-8
    ahead, behind = (
        linearize(camera.take_step(by * step, by * shared), beside + by * paint, problem).cost
        for by in (size, -size)
    )
    slope = float(
        (here.system.right * step).sum() + here.system.right_corner @ [*shared, *paint.ravel()]
    )
    # Differences of a cost of 1e3 known to 1e-13, over 2e-8; the slope is 1e5.
    assert (ahead - behind) / (2.0 * size) == pytest.approx(slope, rel=1e-5)
