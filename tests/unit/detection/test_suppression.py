"""Suppression keeps one box per person, from any detector and any view."""

import numpy as np

from worldpose.detection.interfaces import People
from worldpose.detection.suppression import suppress
from worldpose.detection.views import TiledDetector


def people(*rows):
    rows = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return People(rows[:, :4], rows[:, 4])


def test_the_best_of_two_boxes_of_a_person_stays():
    found = suppress(people([0, 0, 10, 20, 0.5], [1, 0, 11, 20, 0.9], [50, 0, 60, 20, 0.2]), 0.6)
    assert found.scores.tolist() == [0.9, 0.2]


class Blobs:
    """Finds white rectangles of 3 px and more: truth to the pixel, in whatever view."""

    view_size = (64, 48)

    def detect(self, pictures):
        import cv2

        found = []
        for picture in pictures:
            assert picture.shape == (48, 64, 3)
            _, _, stats, _ = cv2.connectedComponentsWithStats(
                (picture[..., 0] > 200).astype(np.uint8)
            )
            found.append(
                people(*[(x, y, x + w - 1, y + h - 1, 0.9) for x, y, w, h, _ in stats[1:] if w > 2])
            )
        return found


def test_everybody_is_found_once_and_whole_whichever_view_shows_them():
    picture = np.zeros((150, 230, 3), dtype=np.uint8)
    rng = np.random.default_rng(1)
    true = []
    for column in range(9):
        for row in range(4):
            x, y = 5 + 25 * column + rng.integers(0, 8), 5 + 36 * row + rng.integers(0, 8)
            picture[y : y + 12, x : x + 6] = 255
            true.append([x, y, x + 5, y + 11])
    found = TiledDetector(Blobs(), (1.0,), view_overlap=0.4, overlap=0.3).detect([picture])[0]
    whole = found.boxes[np.lexsort(found.boxes.T)]
    expected = np.array(true, dtype=np.float64)[np.lexsort(np.array(true).T)]
    # The whole image in one view is blurred: it may find a box as well, never another person.
    assert len(whole) == len(expected)
    assert np.abs(whole - expected).max() <= 4.0
