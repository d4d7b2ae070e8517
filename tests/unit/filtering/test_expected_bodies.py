"""Expected positions, sizes and occlusions of bodies."""

import numpy as np
from bystander import STANDING, expected


def test_a_box_goes_from_the_top_of_the_head_to_the_soles():
    (box,) = expected((0.0, 0.0)).boxes[0]
    # 50 px per metre; the camera is 1 m high. Joints end at 1.63 and 0.10 m and at 0.33 m aside.
    np.testing.assert_allclose(box[[0, 2]], 499.5 + 50.0 * np.array([-0.45, 0.45]), atol=1e-9)
    np.testing.assert_allclose(box[[1, 3]], 299.5 - 50.0 * np.array([0.83, -1.0]), atol=1e-9)


def test_a_body_s_doubt_is_that_of_its_joints_across_the_view():
    assert expected((0.0, 0.0), deviation=0.07).unsure[0, 0] == np.float64(0.07)


def test_who_stands_right_behind_somebody_is_hidden_and_the_one_before_is_not():
    hidden = expected((0.0, 0.0), (0.0, 1.0), (3.0, 1.0)).hidden_joints(0)
    assert not hidden[0].any()
    assert not hidden[2].any()
    # The farther body looks a twentieth smaller and so lies on the nearer one's bones.
    assert hidden[1].mean() > 0.8


def test_half_a_body_behind_another_is_half_hidden():
    # A shoulder's width aside: the arm and leg on that side are behind the other's.
    hidden = expected((0.0, 0.0), (0.35, 1.0)).hidden_joints(0)[1]
    left = STANDING[:, 0] > 0.05
    assert hidden[~left].mean() > 0.4
    assert not hidden[left].any()


def test_people_side_by_side_at_one_depth_hide_nothing_of_one_another():
    # The depth order of the two is uncertain.
    assert not expected((0.0, 0.0), (0.1, 0.1)).hidden_joints(0).any()


def test_who_is_no_body_hides_nobody():
    bodies = expected((0.0, 0.0), (0.0, 1.0))
    for array in (bodies.image, bodies.scale, bodies.depth):
        array[0, 0] = np.nan
    assert not bodies.hidden_joints(0).any()
