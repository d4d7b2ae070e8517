"""A similarity transform of everything: no pixel tells it."""

import numpy as np
import pytest
from lab import ring

from worldpose.bundle_adjustment.uncertainty import (
    relative_covariance,
    similarity_steps,
)
from worldpose.geometry.rigid import Rigid, Similarity
from worldpose.static_calibration.parameters import project_with_jacobian, step_camera
from worldpose.triangulation.world import move_cameras

ORIGIN = np.array([0.3, -0.2, 1.0])


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def turned(scale=1.1):
    return Similarity(
        np.array(scale), Rigid.from_rotvec([0.2, -0.5, 0.9], np.zeros(3)).rotation, ORIGIN
    )


def test_cameras_that_follow_a_transform_see_it_nowhere(rng):
    cameras, points = ring(3, rng), rng.normal(0.0, 0.5, (10, 3))
    moved = turned()
    seen = move_cameras(moved, cameras).project(moved.apply(points))
    np.testing.assert_allclose(seen, cameras.project(points), atol=1e-9)


@pytest.mark.parametrize("parameter", range(7))
def test_steps_are_the_derivatives_of_cameras_that_follow(rng, parameter):
    cameras, points = ring(3, rng), rng.normal(0.0, 0.5, (10, 3))
    small = np.zeros(7)
    small[parameter] = 1e-6
    away = points - ORIGIN
    moved = points + small[:3] + np.cross(small[3:6], away) + small[6] * away
    seen = step_camera(cameras, similarity_steps(cameras, ORIGIN) @ small).project(moved)
    # A thousand pixels times the square of the step are left.
    np.testing.assert_allclose(seen, cameras.project(points), atol=1e-8)


def test_what_cameras_err_by_in_common_is_taken_apart(rng):
    cameras, points = ring(4, rng), rng.normal(0.0, 0.5, (40, 3)) + ORIGIN
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
