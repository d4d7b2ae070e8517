"""Joints from rays: residuals, robust weights, points of known scenes, and chunks of clips."""

import numpy as np
import pytest
from running_samples import detections as seen

from data_contracts.conventions import FEET
from data_contracts.keypoints import KeypointDetections
from worldpose.triangulation.estimate import reconstruct_joints, triangulate_joints
from worldpose.triangulation.noise_model import shared_variance
from worldpose.triangulation.residuals import (
    LANES,
    Buffers,
    Observations,
    Rig,
    add_data,
    clear,
    read_tile,
)
from worldpose.triangulation.settings import TriangulationSettings

POINT = np.array([0.7, -1.1, 1.3])
NOISE = (2.0, 0.0)


def buffers_of(camera, image):
    """Buffers in which every lane sees pixels (cameras, 2), and its joint is at `POINT`."""
    count = len(image)
    keypoints = np.broadcast_to(image[None, :, None, None], (1, count, 1, LANES, 2)).copy()
    precision = np.ones((1, count, 1, LANES))
    rig, buffers = Rig.from_cameras(camera), Buffers.of(count)
    index = np.zeros((1, count, 1), np.int64)
    read_tile(Observations.of(rig, keypoints, precision, index), 0, buffers.tiles)
    buffers.tiles["used"] = 1.0
    buffers.state["point"] = POINT[:, None]
    return rig, buffers


@pytest.fixture
def views(ring):
    """Four views of `POINT`, each some pixels off."""
    camera = ring(4)
    off = np.array([[3, 1], [-2, 4], [1, 1], [0, -3]])
    return camera, camera.project(POINT[None])[:, 0] + off


def test_normal_equations_are_the_gradient_of_half_the_weighted_cost(views):
    camera, image = views
    rig, buffers = buffers_of(camera, image)
    state = buffers.state[0]

    def cost_and_right(point):
        state["point"][:] = point[:, None]
        clear(state)
        for tile, depth in zip(buffers.tiles, rig.depths, strict=True):
            add_data(tile, depth, NOISE, state)
        return 0.5 * buffers.tiles["squared"][:, 0].sum(), state["right"][:, 0].copy()

    _, right = cost_and_right(POINT)
    step = 1e-5
    for axis in range(3):
        ahead, _ = cost_and_right(POINT + step * np.eye(3)[axis])
        behind, _ = cost_and_right(POINT - step * np.eye(3)[axis])
        # Central differences of a cost of about 10 with third derivatives of order 1e3.
        assert right[axis] == pytest.approx(-(ahead - behind) / (2 * step), rel=1e-5, abs=1e-3)


PIXEL_NOISE = 2.0
FPS = 50.0


@pytest.fixture
def clip(ring):
    """Six cameras, two people; true points (frames, persons, 6, 3) and noisy detections."""
    rng = np.random.default_rng(5)
    cameras = ring(6)
    time = np.arange(60)[:, None, None, None] / FPS
    body = rng.uniform(-0.4, 0.4, (1, 2, 23, 3)) + [[[0.0, 0.0, 1.0]]]
    places = body + time * [1.0, 0.5, 0.0]
    keypoints, confidence, index = seen(cameras, places)
    keypoints = keypoints + PIXEL_NOISE * rng.standard_normal(keypoints.shape)
    detections = KeypointDetections.from_keypoints(
        keypoints[..., :17, :], confidence[..., :17], index
    )
    feet = keypoints[..., 17:, :], confidence[..., 17:]
    return cameras, detections, detections.add_points(FEET, *feet), places[..., 17:, :]


def test_joints_are_bit_for_bit_those_without_points(clip):
    cameras, plain, with_feet, _ = clip
    one, two = (reconstruct_joints(cameras, each[:20], FPS) for each in (plain, with_feet))
    assert one.triangulation.extra is None
    for name in ("joints", "covariance", "views", "inliers", "exchanged", "offsets"):
        np.testing.assert_array_equal(
            getattr(one.triangulation, name), getattr(two.triangulation, name)
        )
    np.testing.assert_array_equal(one.smoothing.joints, two.smoothing.joints)


def test_points_are_found_within_their_noise(clip):
    cameras, _, with_feet, truth = clip
    found = triangulate_joints(cameras, with_feet, TriangulationSettings(offsets="none")).extra
    assert found.points == FEET and found.joints.shape == truth.shape
    away = found.joints - truth
    # 30 m away at 1500 px, 2 px are 40 mm across one ray; six views leave half of that.
    assert 0.01 < np.sqrt((away**2).mean()) < 0.03
    seen = (with_feet.detection_index >= 0).sum(axis=1)
    bias = shared_variance(found.common_bias, found.views, seen)
    random = found.covariance - bias[..., None, None] * np.eye(3)
    square = np.einsum("fpka,fpkab,fpkb->fpk", away, np.linalg.inv(random), away)
    assert 2.4 < square.mean() < 3.6  # chi-square of three degrees of freedom
    assert (found.views >= 5).mean() > 0.95


as_detections = KeypointDetections.from_keypoints

SETTINGS = TriangulationSettings()
# Noise as stated, cameras as given: one joint is then a textbook least-squares problem.
STATED = TriangulationSettings(learn_noise=False, offsets="none", common_bias_m=0.0)
# White pixel noise only: the noise that the Monte Carlo tests put in.
WHITE = STATED.model_copy(update={"pixel_noise_px": 1.0, "joint_noise_m": 0.0})


def some_joints(persons=2, count=17, frames=1):
    rng = np.random.default_rng(7)
    return rng.uniform([-4, -4, 0], [4, 4, 2], (frames, persons, count, 3))


def test_one_view_and_two_nearly_parallel_rays_determine_nothing(ring):
    keypoints, confidence, index = seen(ring(3), some_joints())
    index[:, 1:] = -1
    result = triangulate_joints(ring(3), as_detections(keypoints, confidence, index), SETTINGS)
    for found in (result.joints, result.covariance, result.reprojection_error):
        assert np.isnan(found).all()
    assert not result.views.any() and not result.inliers.any()
    assert result.report.undetermined == 34
    # Two cameras 0.06 rad apart on the ring, less than the 0.1 rad asked for.
    narrow = ring(2, arc=0.12)
    given = as_detections(*seen(narrow, some_joints()))
    wide = SETTINGS.model_copy(update={"min_angle_rad": 0.03})
    for settings, known in ((SETTINGS, False), (wide, True)):
        found = triangulate_joints(narrow, given, settings).joints
        assert (np.isfinite(found) == known).all()


def test_nan_keypoints_and_confidence_that_is_not_positive_are_left_out(ring):
    keypoints, confidence, index = seen(ring(5), some_joints())
    keypoints[:, 0] = np.nan
    keypoints[:, 1] += 50.0
    confidence[:, 1], confidence[:, 2], confidence[:, 2, 0] = 0.0, np.nan, -0.5
    result = triangulate_joints(ring(5), as_detections(keypoints, confidence, index), SETTINGS)
    np.testing.assert_array_equal(result.views, 2)
    np.testing.assert_array_equal(result.inliers.any(axis=(0, 2, 3)), [0, 0, 0, 1, 1])
    np.testing.assert_allclose(result.joints, some_joints(), atol=1e-8)


def test_cameras_are_taken_as_a_list_and_by_name_and_indices_as_a_list(ring):
    keypoints, confidence, index = seen(ring(3), some_joints())
    given = as_detections(keypoints, confidence, index.tolist())
    cameras = [ring(3)[n] for n in range(3)]
    for rig in (cameras, dict(zip("abc", cameras, strict=True))):
        result = triangulate_joints(rig, given, SETTINGS)
        np.testing.assert_allclose(result.joints, some_joints(), atol=1e-8)


@pytest.mark.parametrize("count", [2, 4, 16])
def test_noise_free_views_give_the_joint(ring, count):
    # Two cameras of four, so that they do not face each other.
    cameras = ring(4)[np.array([0, 1])] if count == 2 else ring(count)
    joints = some_joints(frames=3)
    result = triangulate_joints(cameras, as_detections(*seen(cameras, joints)), SETTINGS)
    # Undistortion is exact to 1e-13 of the focal length; seen 2e-13 m.
    np.testing.assert_allclose(result.joints, joints, atol=1e-10)
    np.testing.assert_array_equal(result.views, count)
    assert result.inliers.all()
    assert result.reprojection_error.max() < 1e-8
    assert (result.joints.dtype, result.views.dtype) == (np.float64, np.uint8)
    assert result.reprojection_error.dtype == np.float32
    assert result.report.rejected_share == (0.0,) * count


@pytest.mark.parametrize("count", [3, 8])
@pytest.mark.parametrize("offset", [20.0, 500.0])
def test_outlier_view_is_rejected_and_named(ring, count, offset):
    keypoints, confidence, index = seen(ring(count), some_joints())
    keypoints[:, 1] += offset / np.sqrt(2)
    result = triangulate_joints(ring(count), as_detections(keypoints, confidence, index), SETTINGS)
    expected = np.arange(count) != 1
    np.testing.assert_array_equal(
        result.inliers, np.broadcast_to(expected[:, None, None], result.inliers.shape)
    )
    # The outlier is cut, not down-weighted: as exact as without it.
    np.testing.assert_allclose(result.joints, some_joints(), atol=1e-8)
    assert result.report.rejected_share[1] == 1.0


def test_reprojection_error_is_the_root_mean_square_length_in_pixels(ring):
    keypoints, confidence, index = seen(ring(6), some_joints(1, 17))
    keypoints += np.random.default_rng(3).normal(0, 1.0, keypoints.shape)
    result = triangulate_joints(ring(6), as_detections(keypoints, confidence, index), STATED)
    image = ring(6).project(result.joints[0, 0])
    lengths = np.linalg.norm(image - keypoints[0, :, 0], axis=-1)
    inliers = result.inliers[0, :, 0]
    expected = np.sqrt((lengths**2 * inliers).sum(0) / inliers.sum(0))
    # The lens is linearised at the observation: 1 px bends by 1 / 1500 of itself at most.
    np.testing.assert_allclose(result.reprojection_error[0, 0], expected, rtol=1e-3)


def test_result_is_the_least_squares_point_of_the_weighted_pixels(ring):
    keypoints, confidence, index = seen(ring(4), some_joints(1, 3))
    rng = np.random.default_rng(4)
    keypoints += rng.normal(0, 1.0, keypoints.shape)
    confidence[...] = rng.uniform(0.3, 1.0, confidence.shape)
    result = triangulate_joints(ring(4), as_detections(keypoints, confidence, index), WHITE)
    assert result.inliers.all()

    def cost(points):
        errors = ring(4).project(points) - keypoints[0, :, 0]
        return (confidence[0, :, 0] * (errors**2).sum(-1)).sum(0)

    best = cost(result.joints[0, 0])
    for axis in range(3):
        for step in (-1e-3, 1e-3):
            moved = result.joints[0, 0] + step * np.eye(3)[axis]
            # One millimetre costs (0.05 px)^2 per view; the linearised lens shifts the
            # optimum by under a hundredth of that.
            assert (cost(moved) > best).all()


def test_covariance_is_the_spread_of_a_monte_carlo(ring):
    """One joint under white noise, 4000 times."""
    cameras, joint = ring(8, arc=2.0), np.array([1.0, -2.0, 1.2])
    keypoints, confidence, index = seen(cameras, np.broadcast_to(joint, (4000, 1, 1, 3)))
    noise = np.random.default_rng(5).normal(size=keypoints.shape)
    confidence[...] = np.linspace(0.4, 1.0, keypoints.shape[1])[:, None, None]
    keypoints = keypoints + noise / np.sqrt(confidence)[..., None]
    loose = WHITE.model_copy(update={"max_deviation": 6.0})
    result = triangulate_joints(cameras, as_detections(keypoints, confidence, index), loose)
    errors, stated = result.joints[:, 0, 0] - joint, result.covariance[:, 0, 0].mean(axis=0)
    sampled = errors.T @ errors / len(errors)
    # In coordinates where the stated covariance is the identity, the sampled one has entries
    # with standard deviation sqrt(2 / 4000) = 0.022; four of these.
    whiten = np.linalg.inv(np.linalg.cholesky(stated))
    np.testing.assert_allclose(whiten @ sampled @ whiten.T, np.eye(3), atol=0.09)
    # Bias of second order only, below its own sampling error: 4 / sqrt(4000) deviations.
    assert np.abs(whiten @ errors.mean(axis=0)).max() < 4 / np.sqrt(4000)
