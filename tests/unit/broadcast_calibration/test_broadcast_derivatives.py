"""Projection, derivatives and normal equations of the moving camera against differences."""

from dataclasses import replace

import numpy as np
import pytest
import turning_clip as clip

from worldpose.broadcast_calibration.clip_problem import ClipProblem, TermWeights
from worldpose.broadcast_calibration.priors import build_prior
from worldpose.broadcast_calibration.residuals import linearize
from worldpose.broadcast_calibration.settings import BroadcastPrior


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
