"""The z-buffer against triangles whose samples can be counted by hand."""

import numpy as np

from worldpose.geometry.boxes import box_areas, box_iou
from worldpose.geometry.rasters import Samples, Surface, cover_triangles, draw_triangles, resolve

FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
"""Of a rectangle whose corners go down first, as a camera has what faces it."""


def rectangle(left, top, right, bottom, depth=10.0):
    corners = [(left, top), (left, bottom), (right, bottom), (right, top)]
    return np.column_stack([corners, np.broadcast_to(depth, 4)]).astype(np.float32)


def test_a_mask_has_the_pixels_whose_middles_are_covered_whichever_way_triangles_face():
    for faces in (FACES, np.ascontiguousarray(FACES[:, ::-1])):
        mask = np.zeros((5, 5), dtype=np.uint8)
        mask[2, 2] = 1
        cover_triangles(rectangle(0.8, 1.8, 3.2, 3.2), faces, 2, mask)
        expected = np.zeros((5, 5))
        expected[2:4, 1:4] = 2
        expected[2, 2] = 3
        np.testing.assert_array_equal(mask, expected)


def test_half_a_pixel_has_half_its_samples_and_mixes_with_what_is_behind():
    samples, still = Samples.empty(0, 0, 3, 3), rectangle(1.0, 0.5, 1.5, 1.5)
    surface = Surface(
        faces=FACES,
        backs=np.zeros(2, dtype=bool),
        texels=np.zeros((4, 2), dtype=np.float32),
        textures=np.full((2, 1, 1, 3), 200, dtype=np.uint8),
        opened=still,
        closed=still,
        light=np.ones(4, dtype=np.float32),
    )
    # Across, samples lie 0.125 and 0.375 px to both sides of the middle.
    assert draw_triangles(surface, np.zeros(4, dtype=np.float32), 0, samples) == 2
    picture = np.full((3, 3, 3), 100, dtype=np.uint8)
    persons, seen = np.full((3, 3), -1, dtype=np.int16), np.zeros(1, dtype=np.int64)
    resolve(samples.who, samples.color, picture, persons, seen)
    expected = np.full((3, 3), 100)
    expected[1, 1] = 150
    np.testing.assert_array_equal(picture[..., 0], expected)
    assert seen.tolist() == [2]
    assert np.flatnonzero(persons == 0).tolist() == [4]


def test_intersection_over_union_of_every_pair():
    # Two squares of 4 that share 2: 2 of 6.
    found = box_iou(np.array([[0.0, 0, 2, 2]]), np.array([[1.0, 0, 3, 2], [5, 5, 6, 6]]))
    np.testing.assert_allclose(found, [[1 / 3, 0.0]])


def test_boxes_without_area_and_missing_boxes_share_nothing():
    flat, reversed_box = [1.0, 1, 1, 1], [2.0, 2, 0, 0]
    boxes = np.array([flat, reversed_box, [np.nan] * 4, [0.0, 0, 2, 2]])
    assert box_iou(boxes, boxes).tolist() == np.diag([0.0, 0, 0, 1]).tolist()
    assert box_areas(boxes[[0, 1, 3]]).tolist() == [0.0, 0.0, 4.0]
