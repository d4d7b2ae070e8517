"""Matching of predicted and true people, computed by hand."""

import numpy as np
from camera_builders import plain_camera

from worldpose.evaluation.matching import joint_boxes, joint_distances, match_people, merge_tracks
from worldpose.geometry.rigid import Rigid

ONE = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
"""A person of two joints 1 m apart."""


def match_frame(predicted, true, gate):
    return match_people(joint_distances(predicted[None], true[None]), gate)[0].tolist()


def test_nobody_matches_nothing_and_distance_is_over_common_joints_only():
    assert match_frame(ONE[:0], ONE, 1.0) == [-1]
    assert match_frame(ONE, ONE[:0], 1.0) == []
    half = ONE + [0.4, 0.0, 0.0]
    half[0, 1] = np.nan
    assert match_frame(half, ONE, 0.5) == [0]
    assert match_frame(half, ONE, 0.3) == [-1]


def test_split_tracks_are_merged_and_the_nearer_of_two_counts():
    pairs = np.array([[0], [0], [1], [1]])
    cost = np.array([[[0.1, np.inf]], [[0.1, np.inf]], [[0.3, 0.2]], [[np.inf, 0.2]]])
    assert merge_tracks(pairs, cost).tolist() == [[0], [0], [1], [1]]
    cost[2, 0] = [0.1, 0.2]
    assert merge_tracks(pairs, cost).tolist() == [[0], [0], [0], [1]]


def test_boxes_go_around_the_joints_in_front_of_the_camera():
    camera = plain_camera(100.0, (50.0, 50.0), Rigid.identity(), (100, 100))
    one = [[1.0, 2.0, 10.0], [-1.0, 0.0, 10.0], [0.0, 0.0, -5.0]]
    boxes = joint_boxes(np.array([[one, [[np.nan] * 3] * 3]]), camera)
    assert boxes[0, 0].tolist() == [40.0, 50.0, 60.0, 70.0]
    assert np.isnan(boxes[0, 1]).all()
