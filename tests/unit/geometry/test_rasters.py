"""The z-buffer against triangles whose samples can be counted by hand."""

import numpy as np
import pytest

from worldpose.geometry.rasters import Samples, Surface, cover_triangles, draw_triangles, resolve

FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
"""Of a rectangle whose corners go down first, as a camera has what faces it."""
BACKS = np.zeros(2, dtype=bool)
TEXELS = np.zeros((4, 2), dtype=np.float32)
CLEAR = np.zeros(4, dtype=np.float32)


def rectangle(left, top, right, bottom, depth=10.0):
    corners = [(left, top), (left, bottom), (right, bottom), (right, top)]
    return np.column_stack([corners, np.broadcast_to(depth, 4)]).astype(np.float32)


def draw(samples, opened, which, closed=None, faces=FACES, level=200, light=1.0):
    surface = Surface(
        faces=faces,
        backs=BACKS,
        texels=TEXELS,
        textures=np.full((2, 1, 1, 3), level, dtype=np.uint8),
        opened=opened,
        closed=opened if closed is None else closed,
        light=np.full(4, light, dtype=np.float32),
    )
    return draw_triangles(surface, CLEAR, which, samples)


def test_a_rectangle_on_pixel_borders_has_all_samples_of_its_pixels():
    samples = Samples.empty(10, 20, 16, 25)
    # Pixels 12 and 13 in rows 21 to 23 reach from 11.5 to 13.5 and from 20.5 to 23.5.
    assert draw(samples, rectangle(11.5, 20.5, 13.5, 23.5), 0) == 2 * 3 * 4
    hit = np.zeros((5, 6), dtype=bool)
    hit[1:4, 2:4] = True
    np.testing.assert_array_equal((samples.who == 0).all(axis=-1), hit)
    np.testing.assert_array_equal((samples.who == 0).any(axis=-1), hit)
    np.testing.assert_array_equal(samples.depth[hit], np.float32(10.0))
    assert (samples.color[hit] == 200).all()


def test_half_a_pixel_has_half_its_samples_and_mixes_with_what_is_behind():
    samples = Samples.empty(0, 0, 3, 3)
    # Across, samples lie 0.125 and 0.375 px to both sides of the middle.
    assert draw(samples, rectangle(1.0, 0.5, 1.5, 1.5), 0) == 2
    picture = np.full((3, 3, 3), 100, dtype=np.uint8)
    persons, seen = np.full((3, 3), -1, dtype=np.int16), np.zeros(1, dtype=np.int64)
    resolve(samples.who, samples.color, picture, persons, seen)
    expected = np.full((3, 3), 100)
    expected[1, 1] = 150
    np.testing.assert_array_equal(picture[..., 0], expected)
    assert seen.tolist() == [2]
    assert persons[1, 1] == 0
    assert (persons == -1).sum() == 8


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_hides_the_farther_in_any_order_and_both_count_all_their_samples(order):
    samples = Samples.empty(0, 0, 8, 4)
    things = {0: rectangle(0.5, 0.5, 4.5, 2.5, 9.0), 1: rectangle(2.5, 0.5, 6.5, 2.5, 11.0)}
    for which in order:
        assert draw(samples, things[which], which) == 4 * 2 * 4
    assert (samples.who == 0).sum() == 32
    assert (samples.who == 1).sum() == 16


def test_surfaces_that_cross_are_parted_where_they_do():
    samples = Samples.empty(0, 0, 10, 3)
    # From 8 m on the left to 12 m on the right, across one at 10 m: they meet in the middle.
    slanting = rectangle(0.5, 0.5, 8.5, 1.5, [8.0, 8.0, 12.0, 12.0])
    draw(samples, slanting, 0)
    draw(samples, rectangle(0.5, 0.5, 8.5, 1.5, 10.0), 1)
    np.testing.assert_array_equal(samples.who[1, 1:5], 0)
    np.testing.assert_array_equal(samples.who[1, 5:9], 1)


def test_what_faces_away_or_has_no_image_is_not_drawn():
    samples = Samples.empty(0, 0, 5, 5)
    seen = rectangle(0.5, 0.5, 3.5, 3.5)
    assert draw(samples, seen, 0, faces=np.ascontiguousarray(FACES[:, ::-1])) == 0
    gone = seen.copy()
    gone[0] = np.nan  # a corner of both triangles
    assert draw(samples, gone, 0) == 0
    assert (samples.who == -1).all()


def test_what_moves_is_drawn_at_four_moments_of_the_shutter():
    samples = Samples.empty(0, 0, 20, 3)
    opened, closed = rectangle(0.5, 0.5, 2.5, 1.5), rectangle(8.5, 0.5, 10.5, 1.5)
    assert draw(samples, opened, 0, closed) == 2 * 4
    # Its left border is 1, 3, 5 and 7 px on at an eighth, three, five and seven eighths.
    columns = [np.flatnonzero(samples.who[1, :, s] == 0).tolist() for s in range(4)]
    assert sorted(columns) == [[2, 3], [4, 5], [6, 7], [8, 9]]


def test_a_mask_has_the_pixels_whose_middles_are_covered_whichever_way_triangles_face():
    for faces in (FACES, np.ascontiguousarray(FACES[:, ::-1])):
        mask = np.zeros((5, 5), dtype=np.uint8)
        mask[2, 2] = 1
        cover_triangles(rectangle(0.8, 1.8, 3.2, 3.2), faces, 2, mask)
        expected = np.zeros((5, 5))
        expected[2:4, 1:4] = 2
        expected[2, 2] = 3
        np.testing.assert_array_equal(mask, expected)
