"""The detector finds small people and people close together in enlarged parts of a frame."""

import numpy as np

from worldpose.detection.bundled_detector import BundledDetector
from worldpose.detection.enlargement import (
    choose_reduction,
    expect_parts,
    find_groups,
    find_small,
)
from worldpose.detection.interfaces import People
from worldpose.geometry.cameras import Camera
from worldpose.geometry.rigid import Rigid
from worldpose.pitch.template import PitchTemplate

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


def test_an_enlarged_tile_replaces_small_people_and_keeps_tall_ones():
    (tile,) = find_small(people((300.0, 300.0, 310.0, 320.0)), SHAPE, (36.0, 2.0))
    small, moved = (300.0, 300.0, 310.0, 320.0), (301.0, 300.0, 311.0, 321.0)
    tall, other = (295.0, 280.0, 320.0, 340.0), (900.0, 300.0, 910.0, 320.0)
    merged = tile.merge(people(small, tall, other), seen(tile, moved, tall))
    # The tile is no judge of tall people, nor of people outside of it.
    np.testing.assert_allclose(merged.boxes, [tall, other, moved], atol=1e-9)


def looking(focal):
    center, target = np.array([0.0, -75.0, 22.0]), np.array([0.0, 5.0, 0.0])
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Camera(
        focal=np.full(2, focal),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.zeros(5),
        cam_from_world=Rigid(rotation, -rotation @ center),
        image_size=np.array([1920, 1080]),
    )


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


def test_a_frame_of_large_people_is_seen_reduced():
    for height, zoom in ((99.0, 1.0), (101.0, 0.5), (199.0, 0.5), (201.0, 0.25)):
        boxes = [(x, 100.0, x + 30.0, 100.0 + height) for x in (100.0, 300.0, 500.0)]
        assert choose_reduction(people(*boxes)) == zoom
    # Two unsure boxes of fragments do not make the people small.
    large = people((100.0, 100.0, 160.0, 310.0))
    parts = people(*[(x, 100.0, x + 9.0, 130.0) for x in (120.0, 140.0)], score=0.1)
    both = People(
        np.concatenate([large.boxes, parts.boxes]), np.concatenate([large.scores, parts.scores])
    )
    assert choose_reduction(both) == 0.25
    assert choose_reduction(people()) == 1.0


class SizesSeen(BundledDetector):
    """Records the sizes of the images that the net sees; finds a person of a given height."""

    def __init__(self, height):
        self.height, self.shapes = height, []

    def _detect(self, image):
        zoom = image.shape[0] / SHAPE[0]
        self.shapes.append(image.shape[:2])
        return people(tuple(zoom * side for side in (500.0, 300.0, 560.0, 300.0 + self.height)))


def test_the_detector_looks_at_the_size_that_suits_the_people():
    image = np.zeros(SHAPE, dtype=np.uint8)
    for height, last in ((60.0, (1080, 1920)), (150.0, (540, 960)), (260.0, (270, 480))):
        detector = SizesSeen(height)
        (found,) = detector.detect([image])
        assert detector.shapes == [(540, 960), last]
        np.testing.assert_allclose(found.boxes, [[500.0, 300.0, 560.0, 300.0 + height]], atol=2.0)
    # A calibrated camera tells the sizes: there is no second look.
    detector = SizesSeen(150.0)
    detector.detect_parts([image], [])
    assert detector.shapes == [(1080, 1920)]


class Scripted(BundledDetector):
    """A detector whose net finds one person with a score that depends on the image's width."""

    def __init__(self, scores):
        self.scores, self.seen = scores, []

    def _detect(self, image):
        width = image.shape[1]
        self.seen.append(width)
        return people((0.25 * width, 0.0, 0.5 * width, 40.0), score=self.scores.get(width, 0.1))


def test_a_close_up_is_seen_at_the_size_of_its_surest_person():
    frame = np.zeros((1080, 1920, 3), dtype=np.uint8)
    close = Scripted({960: 0.4, 480: 0.5, 240: 0.8, 170: 0.7})
    (found,) = close.detect([frame])
    np.testing.assert_allclose(found.boxes, [[483.5, 3.5, 963.5, 323.5]])
    np.testing.assert_allclose(found.scores, [0.8])
    # A gain within the noise of scores, or a sure person of usual size, leaves the frame as it is.
    for scores in ({960: 0.4, 480: 0.44}, {960: 0.6, 240: 0.95}):
        usual = Scripted(scores)
        usual.detect([frame])
        assert 1920 in usual.seen
    assert 240 not in usual.seen
