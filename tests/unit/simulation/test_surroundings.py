"""What rays that leave the pitch end on: boards, stands, the sky."""

import numpy as np
import pytest

from worldpose.simulation.surroundings import BOARD_HEIGHT, BOARD_SETBACK, scenery

HALF = np.array([52.5, 34.0]) + BOARD_SETBACK
BEND = 0.2 / 34.0**2


def look(start, at):
    """Colour and distance [m] of what is seen from a place in the direction of another."""
    way = np.array(at, dtype=float) - start
    *color, steps = scenery(np.array(start, dtype=float), *way, HALF, BEND, 3)
    return color, steps * np.linalg.norm(way)


@pytest.mark.parametrize("height", [17.0, 25.0])
def test_a_main_camera_built_into_its_stand_or_above_it_sees_the_far_stand(height):
    start = [0.0, -75.0, height]  # the near stand is 18.2 m high there
    color, distance = look(start, [0.0, 60.0, 9.9])
    assert min(color) >= 0.0
    # Rows rise 0.55 m a metre from 42 m behind the middle: 9.9 m high 60 m behind it.
    assert distance == pytest.approx(np.linalg.norm([135.0, height - 9.9]), abs=1e-6)


def test_a_ray_down_to_the_pitch_ends_on_grass():
    color, _ = look([0.0, -75.0, 17.0], [10.0, 5.0, -BEND * 25.0])
    assert color[0] == -1.0


def test_a_board_hides_the_ground_behind_it():
    start = [0.0, 0.0, 10.0]
    _, distance = look(start, [HALF[0], 0.0, 0.5 * BOARD_HEIGHT])
    assert distance == pytest.approx(np.hypot(HALF[0], 10.0 - 0.5 * BOARD_HEIGHT), abs=1e-6)
