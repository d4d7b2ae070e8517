"""Lenses from boards: known truth, images that do not count, and boards that tell nothing."""

import cv2
import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.static_calibration.boards import Board, BoardView, calibrate_lens, choose_views

SIZE = (1280, 720)
MATRIX = np.array([[900.0, 0.0, 655.0], [0.0, 900.0, 349.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.04, 0.0006, -0.0004, 0.0])
PLACES = np.mgrid[:7, :4].T.reshape(-1, 2) * 0.06


def view(rng, tilt=0.6, noise=0.1, far=0.7, bend=0.0):
    """Corners of a tilted board somewhere in the image."""
    turn = rng.uniform(-tilt, tilt, 3)
    middle = np.append(rng.uniform(-0.3, 0.3, 2) * [1.2, 0.6], 1.0) * far
    flat = PLACES - PLACES.mean(axis=0)
    points = np.column_stack([flat, bend * (flat[:, 0] / flat[:, 0].max()) ** 2])
    shown, _ = cv2.projectPoints(points, turn, middle, MATRIX, DISTORTION)
    return BoardView(PLACES, shown.reshape(-1, 2) + rng.normal(0.0, noise, (len(PLACES), 2)))


def test_a_lens_is_found_within_its_stated_uncertainty():
    rng = np.random.default_rng(3)
    off = []
    for _ in range(4):
        fit = calibrate_lens("cam", [view(rng) for _ in range(10)], SIZE)
        lens = fit.lens
        off += [(lens.focal_px - 900.0) / lens.focal_std_px]
        off += (
            (np.array(lens.principal_point_px) - MATRIX[:2, 2]) / lens.principal_point_std_px
        ).tolist()
        assert fit.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.15)
        assert lens.distortion[:2] == pytest.approx(DISTORTION[:2], abs=0.05)
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.8


@pytest.mark.parametrize("bend", [0.0, 0.003])
def test_a_bent_board_is_told_and_widens_the_lens(bend):
    rng = np.random.default_rng(5)
    fits = [calibrate_lens("cam", [view(rng, bend=bend) for _ in range(12)], SIZE) for _ in "ab"]
    assert [fit.bend_m for fit in fits] == pytest.approx([bend] * 2, abs=1e-4)
    off = [(fit.lens.focal_px - 900.0) / fit.lens.focal_std_px for fit in fits]
    assert np.abs(off).max() < 2.0


def test_too_few_boards_and_boards_that_face_the_camera_are_refused():
    rng = np.random.default_rng(6)
    with pytest.raises(InputError, match=r"cam: board images: expected 4 images or more .* 3 of 4"):
        calibrate_lens("cam", [*(view(rng) for _ in range(3)), None], SIZE)
    with pytest.raises(
        InputError, match=r"determine the focal length .* tilted by 30 to 45 degrees"
    ):
        calibrate_lens("cam", [view(rng, tilt=0.01, noise=0.5) for _ in range(6)], SIZE)
    bent = np.random.default_rng(1)
    with pytest.raises(InputError, match=r"788 px .* of 113 px.*bent by about 10 mm"):
        calibrate_lens("cam", [view(bent, bend=0.01) for _ in range(12)], SIZE)


def drawn(board_image, rng):
    """A photograph of a board (without distortion), and its matrix."""
    height, width = board_image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    far = np.array([[250, 150], [950, 130], [1000, 600], [230, 560]], np.float32)
    way = cv2.getPerspectiveTransform(
        corners, far + rng.uniform(-60, 60, (4, 2)).astype(np.float32)
    )
    return cv2.warpPerspective(board_image, way, SIZE, borderValue=255), way


def printed(squares):
    """A printed board (rows, columns) with a border, squares of 60 px."""
    return cv2.copyMakeBorder(squares, *[60] * 4, cv2.BORDER_CONSTANT, value=255)


@pytest.mark.parametrize("charuco", [False, True])
def test_corners_are_found_where_they_were_drawn(charuco):
    if charuco:
        board = Board(8, 5, 0.06, "DICT_4X4_50", 0.045)
        page = printed(board._charuco().generateImage((480, 300), marginSize=0))
    else:
        board = Board(7, 4, 0.06)
        squares = (np.indices((5, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)
        page = printed(np.kron(squares, np.ones((60, 60), np.uint8)))
    image, way = drawn(page, np.random.default_rng(1))
    found = board.find(image)
    inner = np.stack(np.meshgrid(np.arange(2, 9), np.arange(2, 6)), -1).reshape(-1, 1, 2) * 60
    true = cv2.perspectiveTransform(inner.astype(np.float64) - 0.5, way)[:, 0]
    apart = np.linalg.norm(true[:, None] - found.pixels[None], axis=-1)
    assert len(found.pixels) == 28
    assert apart.min(axis=0).max() < 0.3
    assert found.bend < 0.02
    views, size = choose_views([image, image, np.zeros_like(image)], board)
    assert (len(views), size) == (1, SIZE)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (Board(8, 6, 0.06, "DICT_4X4_50", 0.045), ""),
        (Board(6, 8, 0.06, "DICT_5X5_50", 0.045), "8 x 6 squares, not 6 x 8, and markers of DICT"),
    ],
)
def test_boards_of_the_pattern_before_opencv_4_6_and_exchanged_sides_are_found(stated, said):
    old = Board(8, 6, 0.06, "DICT_4X4_50", 0.045)._charuco()
    old.setLegacyPattern(True)
    page = printed(old.generateImage((480, 360), marginSize=0))
    image, _ = drawn(page, np.random.default_rng(1))
    tried = [(stated, ""), *([] if stated.find(image) else stated.others(image))]
    found, told = next((found, note) for board, note in tried if (found := board.find(image)))
    assert len(found.pixels) == 35
    assert found.bend < 0.02
    assert said in told
    assert "before 4.6" in found.note


def test_a_wrong_dictionary_or_marker_is_told():
    blank = np.full((48, 64), 255, np.uint8)
    with pytest.raises(InputError, match=r"board: dictionary: expected one of OpenCV's: DICT_"):
        Board(8, 5, 0.06, "DICT_9", 0.04).find(blank)
    with pytest.raises(
        InputError, match=r"board: marker: expected .* smaller than a square of 0.06"
    ):
        Board(8, 5, 0.06, "DICT_4X4_50", 0.06).find(blank)


FISHEYE = np.array([-0.03, 0.01, -0.004, 0.001])


def fisheye_views(rng, reach):
    matrix = np.array([[420.0, 0.0, 655.0], [0.0, 420.0, 349.0], [0.0, 0.0, 1.0]])
    views = []
    while len(views) < 14:
        turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
        middle = 0.35 * np.append(rng.uniform(-1.0, 1.0, 2) * reach, 1.0)
        points = np.column_stack([PLACES - PLACES.mean(axis=0), np.zeros(len(PLACES))])
        points = points @ turn.T + middle
        if points[:, 2].min() < 0.05:
            continue
        none = np.zeros(3)
        pixels = cv2.fisheye.projectPoints(points[:, None], none, none, matrix, FISHEYE)[0]
        pixels = pixels.reshape(-1, 2) + rng.normal(0.0, 0.1, (len(PLACES), 2))
        if ((pixels > 0) & (pixels < SIZE)).all():
            views.append(BoardView(PLACES, pixels))
    return views


def test_a_fisheye_is_chosen_and_found_within_its_stated_uncertainty():
    fit = calibrate_lens("cam", fisheye_views(np.random.default_rng(1), (1.6, 0.9)), SIZE)
    lens = fit.lens
    assert (lens.lens_model, len(lens.distortion), fit.used.all()) == ("fisheye", 4, True)
    assert fit.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.15)
    assert abs(lens.focal_px - 420.0) < 3.0 * lens.focal_std_px < 5.0
