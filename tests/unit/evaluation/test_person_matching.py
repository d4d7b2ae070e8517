import numpy as np

from worldpose.evaluation.matching import (
    box_overlaps,
    joint_boxes,
    joint_distances,
    match_boxes,
    match_people,
    merge_tracks,
)
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid


def match_frame(predicted, true, gate):
    return match_people(joint_distances(predicted[None], true[None]), gate)[0]


def people(*positions):
    """People of two joints 1 m apart, standing at positions on the x axis."""
    return np.array([[[x, 0.0, 0.0], [x, 0.0, 1.0]] for x in positions])


def test_nobody_on_either_side_matches_nothing():
    nobody = np.empty((0, 2, 3))
    assert match_frame(nobody, people(0.0), 1.0).tolist() == [-1]
    assert match_frame(people(0.0), nobody, 1.0).tolist() == []


def test_distance_is_over_common_joints_only():
    half = people(0.4)
    half[0, 1] = np.nan
    assert match_frame(half, people(0.0), 0.5).tolist() == [0]
    assert match_frame(half, people(0.0), 0.3).tolist() == [-1]


def test_one_good_match_is_not_given_up_for_two_bad_ones():
    # 0.1 and unmatched (1.0) cost less than 0.9 twice.
    assert match_frame(people(0.0, 1.0), people(0.1, -0.9), 1.0).tolist() == [0, -1]


def test_boxes_are_matched_greedily():
    # The best pair 0.9 comes first and leaves 0.5 to the other, though 0.8 twice would be more.
    overlap = np.array([[[0.9, 0.8], [0.8, 0.5]]])
    assert match_boxes(overlap, 0.5).tolist() == [[0, 1]]
    assert match_boxes(overlap, 0.6).tolist() == [[0, -1]]


def test_missing_boxes_match_nothing():
    assert match_boxes(np.array([[[np.nan, 0.7], [np.nan, 0.6]]]), 0.5).tolist() == [[1, -1]]
    assert match_boxes(np.empty((2, 1, 0)), 0.5).tolist() == [[-1], [-1]]
    assert match_boxes(np.empty((2, 0, 3)), 0.5).shape == (2, 0)


def test_a_track_belongs_to_whom_it_is_paired_with_most():
    # Prediction 0 is paired with person 0 in three frames and with person 1 in two.
    pairs = np.array([[0, -1], [0, -1], [0, -1], [-1, 0], [-1, 0]])
    cost = np.full((5, 2, 1), 0.3)
    assert merge_tracks(pairs, cost).tolist() == [[0, -1]] * 5


def test_split_tracks_are_merged_and_the_nearer_of_two_counts():
    pairs = np.array([[0], [0], [1], [1]])
    cost = np.array([[[0.1, np.inf]], [[0.1, np.inf]], [[0.3, 0.2]], [[np.inf, 0.2]]])
    assert merge_tracks(pairs, cost).tolist() == [[0], [0], [1], [1]]
    cost[2, 0] = [0.1, 0.2]
    assert merge_tracks(pairs, cost).tolist() == [[0], [0], [0], [1]]


def test_a_track_that_is_never_paired_belongs_to_nobody():
    assert merge_tracks(np.full((2, 1), -1), np.full((2, 1, 1), 5.0)).tolist() == [[-1], [-1]]
    assert merge_tracks(np.full((2, 1), -1), np.empty((2, 1, 0))).tolist() == [[-1], [-1]]
    assert merge_tracks(np.empty((2, 0), dtype=int), np.empty((2, 0, 3))).shape == (2, 0)


DOWN_Z = Camera(
    focal=np.array([100.0, 100.0]),
    principal_point=np.array([50.0, 50.0]),
    distortion=np.zeros(5),
    cam_from_world=Rigid.identity(),
    image_size=np.array([100, 100]),
)


def overlap(a, b):
    return box_overlaps(np.array([[a]], dtype=float), np.array([[b]], dtype=float))[0, 0, 0]


def test_overlap_of_boxes():
    assert overlap([0, 0, 2, 2], [0, 0, 2, 2]) == 1.0
    # One of 4 + 4 - 1.
    assert overlap([0, 0, 2, 2], [1, 1, 3, 3]) == 1 / 7
    assert overlap([0, 0, 2, 2], [2, 0, 4, 2]) == 0.0
    assert overlap([0, 0, 2, 2], [5, 5, 6, 6]) == 0.0
    assert overlap([1, 1, 1, 1], [1, 1, 1, 1]) == 0.0


def test_missing_boxes_have_no_overlap():
    assert np.isnan(overlap([np.nan] * 4, [0, 0, 2, 2]))
    assert box_overlaps(np.zeros((3, 0, 4)), np.zeros((3, 2, 4))).shape == (3, 2, 0)


def test_boxes_go_around_the_joints_in_front_of_the_camera():
    joints = np.array(
        [[[[1.0, 2.0, 10.0], [-1.0, 0.0, 10.0], [0.0, 0.0, -5.0]], [[np.nan] * 3] * 3]]
    )
    boxes = joint_boxes(joints, DOWN_Z)
    assert boxes[0, 0].tolist() == [40.0, 50.0, 60.0, 70.0]
    assert np.isnan(boxes[0, 1]).all()
