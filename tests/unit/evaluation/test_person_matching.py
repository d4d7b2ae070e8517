import numpy as np

from worldpose.evaluation.matching import (
    joint_boxes,
    joint_distances,
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


def test_split_tracks_are_merged_and_the_nearer_of_two_counts():
    pairs = np.array([[0], [0], [1], [1]])
    cost = np.array([[[0.1, np.inf]], [[0.1, np.inf]], [[0.3, 0.2]], [[np.inf, 0.2]]])
    assert merge_tracks(pairs, cost).tolist() == [[0], [0], [1], [1]]
    cost[2, 0] = [0.1, 0.2]
    assert merge_tracks(pairs, cost).tolist() == [[0], [0], [0], [1]]


DOWN_Z = Camera(
    focal=np.array([100.0, 100.0]),
    principal_point=np.array([50.0, 50.0]),
    distortion=np.zeros(5),
    cam_from_world=Rigid.identity(),
    image_size=np.array([100, 100]),
)


def test_boxes_go_around_the_joints_in_front_of_the_camera():
    joints = np.array(
        [[[[1.0, 2.0, 10.0], [-1.0, 0.0, 10.0], [0.0, 0.0, -5.0]], [[np.nan] * 3] * 3]]
    )
    boxes = joint_boxes(joints, DOWN_Z)
    assert boxes[0, 0].tolist() == [40.0, 50.0, 60.0, 70.0]
    assert np.isnan(boxes[0, 1]).all()
