import numpy as np
import pytest

from worldpose.errors import InputError
from worldpose.pitch.template import PitchTemplate

PITCH = PitchTemplate.standard()


def test_an_unknown_marking_is_an_error():
    with pytest.raises(InputError, match="'crossbar'"):
        PITCH.marking_points("crossbar", 1.0)


def test_a_post_runs_from_the_ground_to_the_crossbar():
    post = PITCH.marking_points("goal_post_left_near", 0.5)
    np.testing.assert_array_equal(post[0], PITCH.points["goal_post_left_near_bottom"])
    np.testing.assert_array_equal(post[-1], PITCH.points["goal_post_left_near_top"])
    # 2.44 m in steps of at most 0.5 m.
    assert len(post) == 6


def test_a_crossbar_hangs_between_the_tops():
    bar = PITCH.marking_points("crossbar_right", 10.0)
    np.testing.assert_array_equal(
        bar, PITCH.positions(["goal_post_right_near_top", "goal_post_right_far_top"])
    )


def test_goals_are_not_painted():
    assert not set(PITCH.goals) & set(PITCH.sample_lines(1.0).names)
    assert set(PITCH.marking_names) == set(PITCH.goals) | set(PITCH.sample_lines(1.0).names)


def test_painted_markings_are_those_of_sample_lines():
    samples = PITCH.sample_lines(0.5)
    for index, name in enumerate(samples.names):
        painted = samples.points_world[samples.marking == index]
        points = PITCH.marking_points(name, 0.5)
        # A full circle comes back to its first point.
        np.testing.assert_array_equal(points[: len(painted)], painted)
        assert len(points) - len(painted) == (name == "center_circle")
