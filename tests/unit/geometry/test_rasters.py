"""The z-buffer against triangles whose samples can be counted by hand."""

import numpy as np

from worldpose.geometry.rasters import cover_triangles

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
