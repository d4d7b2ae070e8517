"""The pitch from above: people where they are, and their kind."""

import numpy as np

from data_contracts.pitch import PitchSpec
from worldpose.formats.tables import Positions
from worldpose.reports.videos import MARGIN_M, PIXELS_PER_M, minimap_frames


def test_people_are_drawn_at_their_places_and_in_the_way_of_their_kind():
    xy = np.array([[[20.0, 10.0], [-20.0, -10.0]], [[np.nan, np.nan], [-20.0, -10.0]]])
    on_plane = np.array([[False, True], [False, True]])
    people = Positions(
        np.array([7, 8]),
        np.array([3, 4]),
        ["", "ann"],
        on_plane,
        xy,
        np.zeros((2, 2, 2, 2)),
        np.full(2, np.nan),
        np.ones((2, 2)),
    )
    first, second = minimap_frames(people, PitchSpec())
    assert first.shape == (780, 1150, 3) and first.dtype == np.uint8

    def colour(image, x, y):
        row = (34.0 + MARGIN_M - y) * PIXELS_PER_M
        return image[round(row), round((52.5 + MARGIN_M + x) * PIXELS_PER_M)].astype(int)

    grass = colour(second, 20.0, 10.0)
    assert np.abs(colour(first, 20.0, 10.0) - grass).max() > 50  # a disc is filled
    np.testing.assert_array_equal(colour(first, -20.0, -10.0), grass)  # a ring is not
    assert np.abs(colour(first, -20.8, -10.0) - grass).max() > 50
