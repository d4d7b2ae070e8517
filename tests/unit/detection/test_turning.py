"""Cameras on their side or upside down: their images are turned for the nets, points back."""

import cv2
import numpy as np
import pytest
from camera_builders import look_at_camera

from data_contracts.keypoints import KeypointDetections
from worldpose.detection.interfaces import People
from worldpose.detection.pipeline import PeopleFinder, Place
from worldpose.detection.settings import DetectionSettings
from worldpose.detection.turning import QuarterTurn
from worldpose.geometry.cameras import Camera

SIZE = (64, 48)


def rolled(quarters, size=SIZE):
    """A camera whose images np.rot90 turns upright, with a lens that has tangential terms."""
    upright = look_at_camera([0.0, -9.0, 2.0], [0.5, 0.0, 1.0], 60.0, size)
    turn = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(90.0 * quarters)]))[0]
    pose = upright.cam_from_world
    matrix = np.array([[60.0, 0.0, 30.0], [0.0, 61.0, 25.0], [0.0, 0.0, 1.0]])
    lens = np.array([-0.1, 0.02, 0.01, -0.02, 0.003])
    return Camera.from_matrices(matrix, lens, turn @ pose.rotation, turn @ pose.translation, size)


class Net:
    """Finds the brightest pixel as a person if the image is wider than high, as upright ones are.

    It also stands for the pose net: all keypoints are the middle of the box.
    """

    view_size = None

    def __init__(self, upright):
        self.upright = upright

    def detect(self, images):
        found = []
        for image in images:
            y, x = np.unravel_index(image[..., 0].argmax(), image.shape[:2])
            is_seen = (image.shape[1], image.shape[0]) == self.upright and image[y, x, 1] == 9
            box = np.array([[x - 2.0, y - 4.0, x + 2.0, y + 4.0]])
            found.append(People(box[: int(is_seen)], np.full(int(is_seen), 0.9)))
        return found

    def estimate(self, image, boxes):
        middle = (boxes[:, None, :2] + boxes[:, None, 2:]) / 2.0
        points = np.repeat(middle, 17, axis=1) + np.arange(17)[:, None] * [0.1, 0.2]
        return KeypointDetections.from_keypoints(points, np.full((len(boxes), 17), 0.9))


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_turned_camera_sees_points_where_the_turned_image_shows_them(quarters):
    camera = rolled(quarters)
    turn = QuarterTurn.of(camera)
    assert (0 if turn is None else turn.quarters) == quarters
    if turn is None:
        return
    places = np.random.default_rng(1).uniform([-2.0, -1.0, 0.0], [2.0, 1.0, 2.0], (20, 3))
    pixels = camera.project(places)
    turned = turn.camera(camera)
    np.testing.assert_allclose(turned.project(places), turn.points(pixels), atol=1e-9)
    np.testing.assert_allclose(turn.points(turn.points(pixels), back=True), pixels, atol=1e-12)
    assert QuarterTurn.of(turned) is None
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    image[7, 20] = 255
    x, y = turn.points([20.0, 7.0]).astype(int)
    assert turn.image(image)[y, x, 0] == 255
    box = np.array([[3.0, 5.0, 9.0, 20.0]])
    np.testing.assert_allclose(turn.boxes(turn.boxes(box), back=True), box)


@pytest.mark.parametrize(
    ("quarters", "is_given", "turned"),
    # In the last row, the nets find people in the images as they are: z of the world is not up.
    [(0, False, 0), (1, False, 1), (3, False, 3), (1, True, 1), (3, True, 3), (1, False, 0)],
)
def test_people_of_a_camera_on_its_side_are_found_where_they_are(quarters, is_given, turned):
    image = np.full((SIZE[1], SIZE[0], 3), 9, np.uint8)
    image[20, 30, 0] = 255
    net = Net(SIZE[::-1] if turned % 2 else SIZE)
    finder = PeopleFinder([net], net, DetectionSettings(find_occluded=False, min_hits=1))
    box = np.array([[28.0, 16.0, 32.0, 24.0]])
    given = {n: People(box, np.array([0.9])) for n in range(20)} if is_given else None
    frames = ((n, image) for n in range(20))
    (found,) = finder.find(frames, Place(rolled(quarters), None), given)
    assert finder.report.quarters == turned
    np.testing.assert_allclose(found.keypoints[:, 0, 0], np.tile([30.0, 20.0], (20, 1)), atol=0.01)
