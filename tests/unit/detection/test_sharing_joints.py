import numpy as np
import torch

from worldpose.detection.bundled_places import likely_places
from worldpose.detection.bundled_surroundings import surroundings
from worldpose.detection.rival_joints import shared_out

AS_IS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_cells_are_as_full_as_boxes_cover_them():
    # A crop of 8 x 12 px: cells of 4 px with their edges at -0.5, 3.5, 7.5 and 11.5.
    box = np.array([-0.5, -0.5, 3.5, 9.5])
    others = np.array([[3.5, -0.5, 5.5, 11.5], [-0.5, 3.5, 7.5, 7.5], [-0.5, -0.5, 3.5, 3.5]])
    mine, before, behind = surroundings(box, others, AS_IS, (8, 12))
    np.testing.assert_allclose(mine, [[1, 0], [1, 0], [0.5, 0]])
    # Only the first one's feet are lower than the one's asked for; two behind make no more of one.
    np.testing.assert_allclose(before, [[0, 0.5], [0, 0.5], [0, 0.5]])
    np.testing.assert_allclose(behind, [[1, 0], [1, 1], [0, 0]])
    alone = surroundings(box, np.empty((0, 4)), AS_IS, (8, 12))
    np.testing.assert_array_equal(alone[0], mine)
    assert not alone[1:].any()


def test_a_mirrored_crop_shows_mirrored_surroundings():
    mirrored = np.array([[-1.0, 0.0, 7.0], [0.0, 1.0, 0.0]])
    box, others = np.array([0.0, 0.0, 3.0, 9.0]), np.array([[2.0, 1.0, 6.0, 12.0]])
    one, other = (surroundings(box, others, crop, (8, 12)) for crop in (AS_IS, mirrored))
    # The map is exact in halves of pixels.
    np.testing.assert_allclose(one[:, :, ::-1], other, atol=1e-6)


def test_places_come_with_their_probability_and_the_likeliest_first():
    maps = torch.full((1, 1, 32, 24), -40.0)
    # A sharp peak of a quarter, and one of three quarters spread over two cells of a row as 2 : 1.
    maps[0, 0, 5, 5], maps[0, 0, 20, 10], maps[0, 0, 20, 11] = 0.0, float(np.log(2.0)), 0.0
    places, mass = likely_places(maps, 3)
    # Cells of 2 px whose first middle is at 0.5.
    torch.testing.assert_close(places[0, 0, :2], torch.tensor([[21.5 - 1 / 3, 40.5], [10.5, 10.5]]))
    # Of whatever is as likely, nothing is left but the rounding of e^-40.
    torch.testing.assert_close(mass[0, 0], torch.tensor([0.75, 0.25, 0.0]), atol=1e-6, rtol=0)


def test_a_peak_at_the_border_is_read_from_what_there_is():
    maps = torch.full((1, 1, 32, 24), -40.0)
    maps[0, 0, 0, 0], maps[0, 0, 0, 1], maps[0, 0, 31, 23] = float(np.log(2.0)), 0.0, 0.0
    places, mass = likely_places(maps, 2)
    torch.testing.assert_close(places[0, 0], torch.tensor([[0.5 + 2 / 3, 0.5], [46.5, 62.5]]))
    torch.testing.assert_close(mass[0, 0], torch.tensor([0.75, 0.25]))


def rivals(first, second, boxes=((0, 0, 40, 100), (20, 0, 60, 100))):
    """Where two people have their noses, of x 10, 30 and 50 with these chances."""
    places = np.zeros((2, 17, 3, 2))
    places[..., 0] = [10.0, 30.0, 50.0]
    mass = np.tile(np.array([first, second])[:, None], (1, 17, 1))
    # The likeliest come first.
    order = np.argsort(-mass, axis=-1, kind="stable")
    places = np.take_along_axis(places, order[..., None], axis=2)
    mass = np.take_along_axis(mass, order, axis=2)
    taken = shared_out(places, mass, np.array(boxes, dtype=np.float64))
    return np.take_along_axis(places, taken[..., None, None], axis=2)[:, 0, 0, 0].tolist()


def test_who_is_less_sure_leaves_a_place_to_his_neighbour():
    assert rivals([0.1, 0.9, 0.0], [0.0, 0.5, 0.4]) == [30.0, 50.0]
    # He does not take one that is next to impossible.
    assert rivals([0.1, 0.9, 0.0], [0.0, 0.98, 0.015]) == [30.0, 30.0]


def test_a_joint_is_not_put_where_a_neighbour_has_that_of_the_other_side():
    places, mass = np.zeros((2, 17, 2, 2)), np.zeros((2, 17, 2))
    # Joints of their own, far from all others, but for one's left ankle and the other's right.
    places[..., 0, 1] = np.arange(34).reshape(2, 17) * 100.0
    mass[..., 0] = 1.0
    left, right = 15, 16
    places[0, left, 0] = places[1, right, 0] = [5.0, -100.0]
    places[1, right, 1], mass[1, right] = [20.0, -100.0], [0.5, 0.4]
    taken = shared_out(places, mass, np.array([[0.0, 0.0, 40.0, 100.0], [20.0, 0.0, 60.0, 100.0]]))
    assert np.argwhere(taken).tolist() == [[1, right]]


def test_people_apart_have_no_say_in_each_others_joints():
    apart = ((0, 0, 40, 100), (41, 0, 81, 100))
    assert rivals([0.1, 0.9, 0.0], [0.0, 0.5, 0.4], apart) == [30.0, 30.0]


def test_nobody_and_somebody_alone_take_the_likeliest():
    assert shared_out(np.empty((0, 17, 3, 2)), np.empty((0, 17, 3)), np.empty((0, 4))).size == 0
    mass = np.tile([0.5, 0.3], (1, 17, 1))
    taken = shared_out(np.zeros((1, 17, 2, 2)), mass, np.array([[0.0, 0.0, 9.0, 9.0]]))
    assert not taken.any()
