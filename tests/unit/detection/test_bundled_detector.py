"""The detector finds people close together in an enlarged view, in frame coordinates."""

import numpy as np

from worldpose.detection.bundled_detector import find_groups
from worldpose.detection.interfaces import People

SHAPE = (1080, 1920, 3)


def people(*boxes, score=0.9):
    return People(np.array(boxes, dtype=float).reshape(-1, 4), np.full(len(boxes), score))


def test_neighbours_make_a_group_and_others_none():
    near, beside = (100.0, 100.0, 120.0, 150.0), (110.0, 102.0, 130.0, 152.0)
    alone, tall = (400.0, 100.0, 420.0, 150.0), (700.0, 100.0, 800.0, 330.0)
    found = find_groups(people(near, beside, alone, tall, tuple(x + 20 for x in tall)), SHAPE)
    # Two people of 50 px, shown as of 100 and 150 px; those of 230 px are seen well enough.
    assert [group.zoom for group in found] == [2.0, 3.0]
    for group in found:
        np.testing.assert_allclose(group.inner, [87.5, 87.5, 142.5, 164.5])
    assert find_groups(people(near, beside, score=0.2), SHAPE) == []
    assert find_groups(people(), SHAPE) == []


def test_a_group_that_fills_the_picture_is_not_worth_a_second_look():
    row = [(x, 10.0, x + 20.0, 50.0) for x in np.arange(0.0, 1900.0, 10.0)]
    # The part is 1920 x 70 px; enlarged it has at most as many pixels as the image.
    (group,) = find_groups(people(*row), (280, 1920, 3))
    np.testing.assert_allclose(group.zoom, 2.0)
    assert find_groups(people(*row), (60, 1920, 3)) == []


def test_a_box_seen_from_nearer_lies_where_it_is_in_the_picture():
    group, _ = find_groups(
        people((30.0, 31.0, 60.0, 92.0), (40.0, 31.0, 70.0, 92.0)), (300, 411, 3)
    )
    picture = np.zeros((300, 411, 3), dtype=np.uint8)
    picture[40:90, 35:55] = 255
    shown = group.crop(picture)[..., 0]
    rows, columns = np.nonzero(shown > 127)
    seen = (columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5)
    back = group.to_frame(people(seen))
    # A pixel of the enlarged part is half a pixel of the image; edges are known to half of one.
    np.testing.assert_allclose(back.boxes, [[34.5, 39.5, 54.5, 89.5]], atol=0.3)
    # People outside of the group, or of another size, come from the view of the whole frame.
    assert len(group.to_frame(people((0.0, 0.0, 400.0, 500.0), (5.0, 5.0, 9.0, 9.0))).scores) == 0
