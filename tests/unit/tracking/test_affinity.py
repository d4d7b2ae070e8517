import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from worldpose.cameras import Rays, distance_to_rays
from worldpose.tracking.affinity import match_greedily, ray_affinity

ORIGIN = np.zeros((1, 3))
ALONG_Y = np.array([0.0, 1.0, 0.0])


def rays(*directions):
    """One camera, one detection."""
    return np.array(directions, dtype=float)[None, None]


def test_affinity_is_minus_the_mean_distance_to_the_rays():
    # 3 m beside the y axis, and 1 m above it: mean 2 m.
    joints = np.array([[[3.0, 4.0, 0.0], [0.0, 9.0, 1.0]]])
    affinity = ray_affinity(joints, ORIGIN, rays(ALONG_Y, ALONG_Y), 1)
    assert affinity.shape == (1, 1, 1)
    np.testing.assert_allclose(affinity, -2.0, rtol=1e-15)


def test_joints_missing_on_either_side_are_left_out():
    nothing = np.full(3, np.nan)
    joints = np.array([[[3.0, 4.0, 0.0], [0.0, 9.0, 1.0], nothing]])
    affinity = ray_affinity(joints, ORIGIN, rays(ALONG_Y, nothing, ALONG_Y), 1)
    np.testing.assert_allclose(affinity, -3.0, rtol=1e-15)


def test_too_few_common_joints_have_no_affinity():
    joints = np.array([[[3.0, 4.0, 0.0], [np.nan] * 3]])
    assert ray_affinity(joints, ORIGIN, rays(ALONG_Y, ALONG_Y), 2).item() == -np.inf


def test_joint_behind_the_camera_is_as_far_as_the_camera():
    joints = np.array([[[3.0, -4.0, 0.0]]])
    np.testing.assert_allclose(ray_affinity(joints, ORIGIN, rays(ALONG_Y), 1), -5.0, rtol=1e-15)


def test_no_people_and_no_detections_give_empty_affinity():
    assert ray_affinity(np.empty((0, 2, 3)), ORIGIN, rays(ALONG_Y, ALONG_Y), 1).shape == (1, 0, 1)
    assert ray_affinity(np.zeros((3, 2, 3)), ORIGIN, np.empty((1, 0, 2, 3)), 1).shape == (1, 3, 0)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_affinity_agrees_with_the_cameras_package(seed):
    rng = np.random.default_rng(seed)
    joints = rng.normal(0, 20, (3, 4, 3))
    centers = rng.normal(0, 50, (2, 3))
    directions = rng.normal(size=(2, 5, 4, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    expected = distance_to_rays(
        joints[None, :, None],
        Rays(centers[:, None, None, None], directions[:, None], np.zeros((2, 1, 5, 4), np.uint8)),
    )
    # The same formula twice; 50 m with 1e-16 relative rounding.
    np.testing.assert_allclose(
        ray_affinity(joints, centers, directions, 1), -expected.mean(-1), atol=1e-12
    )


def test_best_pair_is_matched_first_and_each_detection_once():
    # Person 0 is 0.2 from detection 0 and 0.3 from 1; person 1 is 0.1 from 0 and 0.9 from 1.
    affinity = -np.array([[[0.2, 0.3], [0.1, 0.9]]])
    assert match_greedily(affinity, 0.5).tolist() == [[1, 0]]


def test_gate_is_the_largest_accepted_distance():
    affinity = -np.array([[[0.5, 0.7]], [[0.500001, 0.7]]])
    assert match_greedily(affinity, 0.5).tolist() == [[0], [-1]]


def test_equal_pairs_go_to_the_first():
    assert match_greedily(np.full((1, 2, 2), -0.1), 0.5).tolist() == [[0, 1]]


def test_infinite_distance_is_never_matched():
    assert match_greedily(np.full((2, 1, 3), -np.inf), np.finfo(float).max).tolist() == [[-1], [-1]]
