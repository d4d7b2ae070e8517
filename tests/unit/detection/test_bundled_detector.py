"""The detector finds small people and people close together in enlarged parts of a frame."""

import numpy as np
from camera_builders import look_at_camera

from worldpose.detection.enlargement import expect_parts, find_small
from worldpose.detection.interfaces import People
from worldpose.pitch.template import PitchTemplate

SHAPE = (1080, 1920, 3)


def people(*boxes, score=0.9):
    return People(np.array(boxes, dtype=float).reshape(-1, 4), np.full(len(boxes), score))


def test_small_people_are_seen_in_enlarged_tiles_and_tall_ones_are_not():
    small = [(x, 500.0, x + 10.0, 520.0) for x in np.arange(100.0, 1900.0, 100.0)]
    step = (36.0, 2.0)
    tiles = find_small(people(*small), SHAPE, step)
    assert len(tiles) == 4  # 1782 px and a margin on both sides, enlarged, in tiles of 1024 px
    for box in small:
        # Each person's centre lies in one tile, whose crop shows the person whole.
        (tile,) = [t for t in tiles if len(t.merge(people(), seen(t, box)).scores)]
        assert np.all(np.array(tile.corner) < box[:2]) and np.all(np.array(tile.end) > box[2:])
        np.testing.assert_allclose(tile.to_frame(seen(tile, box)).boxes, [box], atol=1e-9)
    tall = [(x, 400.0, x + 20.0, 440.0) for x in np.arange(100.0, 1900.0, 50.0)]
    assert find_small(people(*small, *tall), SHAPE, step) == []
    # If no box is sure, all boxes give the size.
    assert find_small(people(*small, score=0.1), SHAPE, step)
    assert find_small(people(), SHAPE, step) == []


def seen(part, *boxes):
    """Boxes of the frame as found in the crop of a part."""
    shift = np.tile(np.array(part.corner), 2)
    return people(*((np.array(boxes) - shift + 0.5) * part.zoom - 0.5))


def looking(focal):
    return look_at_camera((0.0, -75.0, 22.0), (0.0, 5.0, 0.0), focal)


def test_a_calibrated_camera_tells_where_people_are_small():
    pitch = PitchTemplate.standard()
    assert {part.zoom for part in expect_parts(looking(3200.0), pitch, 2.5)} == {0.5}  # 136 px
    assert {part.zoom for part in expect_parts(looking(12000.0), pitch, 2.5)} == {0.5, 0.25}
    assert {tile.zoom for tile in expect_parts(looking(1000.0), pitch, 2.5)} == {2.0, 3.0}
    camera = looking(1250.0)
    tiles = expect_parts(camera, pitch, 2.5)
    assert {tile.zoom for tile in tiles} == {2.0}
    for y, wanted in ((33.0, True), (-33.0, False)):  # 20 and 48 px
        (feet, head) = camera.project(np.array([[5.0, y, 0.0], [5.0, y, 1.8]]))
        middle = 0.5 * (feet + head)
        box = np.array([middle[0] - 4, head[1], middle[0] + 4, feet[1]])
        found = any(len(tile.to_frame(seen(tile, box)).scores) for tile in tiles)
        assert found == wanted
