import numpy as np
import pytest

from worldpose.simulation.detecting import Detections
from worldpose.simulation.reporting import report


def reporting(keypoints, confidence, size, *, merged=None, dropped=None, seed=0):
    shape = confidence.shape[:2]
    merged = np.full(shape, -1, dtype=np.int16) if merged is None else merged
    dropped = np.zeros(len(confidence), dtype=bool) if dropped is None else dropped
    detections = Detections(keypoints, confidence, np.zeros(confidence.shape, dtype=bool), merged)
    made = report(40, detections, size, dropped, np.random.default_rng(seed))
    return made.observations, made.person


def reported(found, seed=0):
    """People that are found or not (frames, bodies), each with its number as coordinate."""
    found = np.array(found, dtype=bool)
    keypoints = np.where(
        found[..., None, None], np.arange(found.shape[1])[:, None, None] * np.ones((17, 2)), np.nan
    )
    confidence = np.where(found[..., None], np.full(17, 0.5), np.nan)
    size = np.full(found.shape, 100.0)
    return reporting(keypoints, confidence, size, seed=seed)


def test_identities_name_the_body_of_every_detection():
    observations, identity = reported(np.random.default_rng(1).random((300, 4)) < 0.7)
    number = observations.keypoints[..., 0, 0]
    np.testing.assert_array_equal(np.where(np.isnan(number), -1, number), identity)
    assert observations.frame.tolist() == list(range(40, 340))


def test_padding_comes_last_and_is_all_missing():
    observations, identity = reported([[1, 0, 1], [0, 0, 0], [0, 1, 0]])
    assert observations.keypoints.shape == (3, 2, 17, 2)
    assert (identity >= 0).tolist() == [[True, True], [False, False], [True, False]]
    for array in observations.arrays().values():
        assert np.isnan(array[1]).all()
        assert np.isnan(array[2, 1]).all()


def test_order_tells_nothing_about_identity():
    _, identity = reported(np.ones((6000, 3)))
    for place in range(3):
        counts = np.bincount(identity[:, place], minlength=3)
        # 6000 draws: standard deviation of a count of 2000 is 37.
        np.testing.assert_allclose(counts, 2000, atol=150)
    # Whoever is first says nothing about the next frame: a third of the time the same.
    assert (identity[1:, 0] == identity[:-1, 0]).mean() == pytest.approx(1 / 3, abs=0.03)


def test_boxes_hold_the_keypoints_with_room_of_six_percent_of_the_height():
    keypoints = np.full((1, 1, 17, 2), np.nan)
    keypoints[0, 0, 0], keypoints[0, 0, 1] = (10.0, 20.0), (30.0, 60.0)
    confidence = np.where(np.isnan(keypoints[..., 0]), np.nan, 0.5)
    confidence[0, 0, 1] = 1.0
    observations, _ = reporting(keypoints, confidence, np.array([[100.0]]))
    assert observations.boxes[0, 0].tolist() == [4.0, 14.0, 36.0, 66.0]
    assert observations.score[0, 0] == 0.75


def test_nobody_found_leaves_no_detections():
    observations, identity = reported(np.zeros((4, 2)))
    assert observations.keypoints.shape == (4, 0, 17, 2)
    assert identity.shape == (4, 0)


def test_dropped_frames_have_no_detections():
    keypoints, confidence = np.ones((3, 2, 17, 2)), np.ones((3, 2, 17))
    dropped = np.array([False, True, False])
    observations, identity = reporting(keypoints, confidence, np.ones((3, 2)), dropped=dropped)
    assert observations.frame.tolist() == [40, 41, 42]
    for array in observations.arrays().values():
        assert np.isnan(array[1]).all()
        assert np.isfinite(array[[0, 2]]).all()
    assert (identity[1] == -1).all()


def test_a_merged_box_is_wider_by_half_a_body():
    keypoints, confidence = np.full((1, 2, 17, 2), 50.0), np.ones((1, 2, 17))
    keypoints[0, 0], confidence[0, 0] = np.nan, np.nan
    merged = np.array([[1, -1]], dtype=np.int16)
    observations, identity = reporting(keypoints, confidence, np.full((1, 2), 100.0), merged=merged)
    # Room of 6 px, and 20 % of the lost one's 100 px on one side.
    assert observations.boxes[0, 0].tolist() == [44.0, 44.0, 76.0, 56.0]
    assert identity.tolist() == [[1]]
