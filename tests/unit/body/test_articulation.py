import numpy as np

from worldpose.body.model import articulate
from worldpose.geometry.rigid import Rigid

CHAIN = np.array([-1, 0, 1])
REST = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
QUARTER = Rigid.from_rotvec([0.0, 0.0, np.pi / 2], np.zeros(3)).rotation

# Sums and products of a few numbers of order 1.
ROUNDING = 1e-12


def test_a_quarter_turn_at_the_root_and_one_at_the_elbow():
    # x turns to y at the root; at the second joint y turns to -x.
    posed = articulate(REST, np.stack([QUARTER, QUARTER, np.eye(3)]), CHAIN)
    np.testing.assert_allclose(posed.joints, [[0, 0, 0], [0, 1, 0], [-2, 1, 0]], atol=ROUNDING)


def test_the_root_turns_about_itself():
    shifted = REST + np.array([5.0, 6.0, 7.0])
    posed = articulate(shifted, np.stack([QUARTER, np.eye(3), np.eye(3)]), CHAIN)
    np.testing.assert_allclose(posed.joints[0], shifted[0], atol=ROUNDING)
    np.testing.assert_allclose(posed.joints[2], shifted[0] + [0, 3, 0], atol=ROUNDING)
