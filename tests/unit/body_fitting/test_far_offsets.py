import numpy as np

from data_contracts.conventions import COCO17
from worldpose.body_fitting.report import far_offsets


def test_offsets_that_no_detector_usually_has_are_named_once_for_both_sides():
    offsets = np.zeros((17, 3))
    left, right = COCO17.index("left_wrist"), COCO17.index("right_wrist")
    offsets[left], offsets[right] = [0.0, 0.06, -0.08], [0.0, -0.06, -0.08]
    offsets[0] = [0.05, 0.0, 0.0]
    found = far_offsets(offsets, np.full(17, 0.03))
    assert list(found) == ["wrist"]
    np.testing.assert_allclose(found["wrist"], [0.10, 0.09])
