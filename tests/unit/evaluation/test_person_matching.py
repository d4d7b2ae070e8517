import numpy as np

from worldpose.evaluation import match_frame


def people(*positions):
    """People of two joints 1 m apart, standing at positions on the x axis."""
    return np.array([[[x, 0.0, 0.0], [x, 0.0, 1.0]] for x in positions])


def test_nobody_on_either_side_matches_nothing():
    nobody = np.empty((0, 2, 3))
    assert match_frame(nobody, people(0.0), 1.0).tolist() == [-1]
    assert match_frame(people(0.0), nobody, 1.0).tolist() == []


def test_people_without_a_common_joint_do_not_match():
    head_only, feet_only = people(0.0), people(0.0)
    head_only[0, 0], feet_only[0, 1] = np.nan, np.nan
    assert match_frame(head_only, feet_only, 1.0).tolist() == [-1]


def test_distance_is_over_common_joints_only():
    half = people(0.4)
    half[0, 1] = np.nan
    assert match_frame(half, people(0.0), 0.5).tolist() == [0]
    assert match_frame(half, people(0.0), 0.3).tolist() == [-1]


def test_a_match_at_the_gate_is_a_match():
    assert match_frame(people(1.0), people(0.0), 1.0).tolist() == [0]


def test_one_good_match_is_not_given_up_for_two_bad_ones():
    # 0.1 and unmatched (1.0) cost less than 0.9 twice.
    assert match_frame(people(0.0, 1.0), people(0.1, -0.9), 1.0).tolist() == [0, -1]


def test_every_prediction_is_used_once():
    assert sorted(match_frame(people(0.0, 0.1), people(0.05, 0.06, 0.07), 1.0).tolist()) == [
        -1,
        0,
        1,
    ]
