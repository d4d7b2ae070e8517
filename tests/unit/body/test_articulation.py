import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from worldpose.body.model import articulate
from worldpose.geometry.rigid import Rigid

CHAIN = np.array([-1, 0, 1])
REST = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
QUARTER = Rigid.from_rotvec([0.0, 0.0, np.pi / 2], np.zeros(3)).rotation

# Sums and products of a few numbers of order 1.
ROUNDING = 1e-12


def test_unturned_joints_stay():
    posed = articulate(REST, np.tile(np.eye(3), (3, 1, 1)), CHAIN)
    np.testing.assert_array_equal(posed.joints, REST)
    np.testing.assert_array_equal(posed.offsets, 0.0)
    np.testing.assert_array_equal(posed.pose_feature, 0.0)


def test_a_quarter_turn_at_the_root_and_one_at_the_elbow():
    # x turns to y at the root; at the second joint y turns to -x.
    posed = articulate(REST, np.stack([QUARTER, QUARTER, np.eye(3)]), CHAIN)
    np.testing.assert_allclose(posed.joints, [[0, 0, 0], [0, 1, 0], [-2, 1, 0]], atol=ROUNDING)


def test_the_root_turns_about_itself():
    shifted = REST + np.array([5.0, 6.0, 7.0])
    posed = articulate(shifted, np.stack([QUARTER, np.eye(3), np.eye(3)]), CHAIN)
    np.testing.assert_allclose(posed.joints[0], shifted[0], atol=ROUNDING)
    np.testing.assert_allclose(posed.joints[2], shifted[0] + [0, 3, 0], atol=ROUNDING)


def test_every_joint_is_carried_by_its_own_frame():
    rng = np.random.default_rng(0)
    local = Rigid.from_rotvec(rng.normal(size=(4, 3, 3)), np.zeros(3)).rotation
    rest = rng.normal(size=(4, 3, 3))
    posed = articulate(rest, local, CHAIN)
    carried = np.einsum("njab,njb->nja", posed.rotations, rest) + posed.offsets
    np.testing.assert_allclose(carried, posed.joints, atol=ROUNDING)


@given(st.lists(st.floats(-3.0, 3.0), min_size=9, max_size=9))
def test_bones_keep_their_lengths(angles):
    local = Rigid.from_rotvec(np.reshape(angles, (3, 3)), np.zeros(3)).rotation
    joints = articulate(REST, local, CHAIN).joints
    lengths = np.linalg.norm(np.diff(joints, axis=0), axis=1)
    np.testing.assert_allclose(lengths, [1.0, 2.0], atol=ROUNDING)


def test_inputs_are_left_alone():
    local = np.stack([QUARTER] * 3)
    rest = REST.copy()
    articulate(rest, local, CHAIN)
    np.testing.assert_array_equal(rest, REST)
    np.testing.assert_array_equal(local, np.stack([QUARTER] * 3))
