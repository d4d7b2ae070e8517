import numpy as np

from worldpose.geometry.boxes import box_areas, box_iou


def test_intersection_over_union_of_every_pair():
    # Two squares of 4 that share 2: 2 of 6.
    found = box_iou(np.array([[0.0, 0, 2, 2]]), np.array([[1.0, 0, 3, 2], [5, 5, 6, 6]]))
    np.testing.assert_allclose(found, [[1 / 3, 0.0]])


def test_boxes_without_area_and_missing_boxes_share_nothing():
    flat, reversed_box = [1.0, 1, 1, 1], [2.0, 2, 0, 0]
    boxes = np.array([flat, reversed_box, [np.nan] * 4, [0.0, 0, 2, 2]])
    assert box_iou(boxes, boxes).tolist() == np.diag([0.0, 0, 0, 1]).tolist()
    assert box_areas(boxes[[0, 1, 3]]).tolist() == [0.0, 0.0, 4.0]
