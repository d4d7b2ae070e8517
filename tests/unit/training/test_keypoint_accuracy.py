import numpy as np
import pytest

from worldpose.training import calibration_error, correct_keypoints
from worldpose.training.keypoint_accuracy import torso_sizes

LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_HIP, RIGHT_HIP, NOSE = 5, 6, 11, 12, 0


@pytest.fixture
def person():
    """Shoulders 40 px apart, 30 px above both hips, which are on one point between them."""
    keypoints = np.zeros((1, 17, 2))
    keypoints[0, LEFT_SHOULDER], keypoints[0, RIGHT_SHOULDER] = (40.0, 0.0), (0.0, 0.0)
    keypoints[0, LEFT_HIP] = keypoints[0, RIGHT_HIP] = (0.0, 30.0)
    return keypoints


def test_a_torso_is_its_longer_diagonal(person):
    # From the left shoulder 40 across and 30 down; from the right one 30 down.
    assert torso_sizes(person) == pytest.approx([50.0])


def test_a_keypoint_within_a_fifth_of_the_torso_is_correct(person):
    found = person.copy()
    found[0, NOSE, 0] = 10.0
    found[0, LEFT_HIP, 1] += 10.01
    correct = correct_keypoints(found, person)
    assert correct[0, NOSE] == 1.0 and correct[0, LEFT_HIP] == 0.0
    assert correct.sum() == 16.0


def test_a_missing_keypoint_is_not_correct_and_an_unknown_one_does_not_count(person):
    found, true = person.copy(), person.copy()
    found[0, 9], true[0, 10] = np.nan, np.nan
    correct = correct_keypoints(found, true)
    assert correct[0, 9] == 0.0 and np.isnan(correct[0, 10])


def test_without_a_torso_nothing_counts(person):
    true = person.copy()
    true[0, LEFT_HIP] = true[0, RIGHT_HIP] = np.nan
    assert np.isnan(correct_keypoints(person, true)).all()


def test_confidence_that_says_the_share_of_right_ones_is_calibrated():
    confidence = np.array([0.25] * 4 + [0.75] * 4)
    right = np.array([True, False, False, False, True, True, True, False])
    assert calibration_error(confidence, right, classes=2) == pytest.approx(0.0)
    # All right: 0.75 and 0.25 too modest, each for half of them.
    assert calibration_error(confidence, np.ones(8, dtype=bool), classes=2) == pytest.approx(0.5)
