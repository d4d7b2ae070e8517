from dataclasses import replace

import numpy as np
import pytest

from worldpose.body.jacobian import ChainedKeypoints
from worldpose.body.keypoints import BODY25, fold_keypoints
from worldpose.body.model import BodyParameters

NAMES = ("betas", "global_orient", "body_pose", "transl")
STEP = 1e-6


@pytest.fixture(params=["open_body", "corrected_body"])
def folded(request):
    return fold_keypoints(request.getfixturevalue(request.param), BODY25)


def differences(folded, people, name):
    """Central differences (..., keypoints, 3, parameters)."""
    given = getattr(people, name)
    columns = []
    for column in range(given.shape[-1]):
        step = STEP * np.eye(given.shape[-1])[column]
        up, down = (replace(people, **{name: given + sign * step}) for sign in (1, -1))
        columns.append((folded(up) - folded(down)) / (2.0 * STEP))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("name", NAMES[:3])
def test_derivatives_are_those_of_differences(folded, people, name):
    jacobian = ChainedKeypoints.of(folded).differentiate(people)
    # Rounding at 100 m over a step of 1e-6: 1e-8; the step's own error is far below.
    np.testing.assert_allclose(
        getattr(jacobian, name), differences(folded, people, name), atol=5e-8
    )


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.1001, 3.0])
def test_angles_of_any_size_have_exact_derivatives(folded, angle):
    axis = np.array([0.48, -0.6, 0.64])
    pose = np.zeros((23, 3))
    pose[[0, 3, 8, 16]] = angle * axis
    person = BodyParameters(np.zeros(10), angle * axis, pose.ravel(), np.zeros(3))
    jacobian = ChainedKeypoints.of(folded).differentiate(person)
    np.testing.assert_allclose(jacobian.keypoints, folded(person), atol=1e-14)
    for name in ("global_orient", "body_pose"):
        # Rounding at 1 m over a step of 1e-6, and the step's own error of 1e-12.
        np.testing.assert_allclose(
            getattr(jacobian, name), differences(folded, person, name), atol=2e-9
        )


def test_a_missing_person_is_missing_and_the_next_is_not(open_body, people):
    pose = people.body_pose.copy()
    pose[1] = np.nan
    chained = ChainedKeypoints.of(fold_keypoints(open_body, ("left_wrist",)))
    jacobian = chained.differentiate(replace(people, body_pose=pose))
    assert np.isnan(jacobian.keypoints[1]).all()
    np.testing.assert_array_equal(jacobian.pose[2], chained.differentiate(people).pose[2])
