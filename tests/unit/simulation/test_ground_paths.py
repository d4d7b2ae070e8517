import numpy as np
import pytest

from worldpose.simulation import CrowdSettings
from worldpose.simulation.paths import (
    LATERAL_ACCELERATION,
    MARGIN,
    STEP,
    TURN_RATE,
    wander,
)

CROWD = CrowdSettings()


@pytest.fixture(scope="module")
def paths():
    made = []
    for seed in range(6):
        made.append(wander(CROWD, 20.0, made, np.random.default_rng(seed)))
    return made


def test_time_covers_the_clip_and_a_margin_on_either_side(paths):
    time = paths[0].time
    # Sums of steps of 0.01: rounding only.
    assert time[0] == pytest.approx(-MARGIN, abs=1e-12)
    assert time[-1] == pytest.approx(20.0 + MARGIN, abs=1e-9)
    np.testing.assert_allclose(np.diff(time), STEP, atol=1e-12)


def test_speed_is_what_the_positions_say_and_within_its_range(paths):
    for path in paths:
        moved = np.linalg.norm(np.diff(path.position, axis=0), axis=-1) / STEP
        # Each step goes exactly speed x time.
        np.testing.assert_allclose(moved, path.speed[:-1], rtol=1e-9)
        assert path.speed.min() >= CROWD.speed[0]
        assert path.speed.max() <= CROWD.speed[1]


def test_speeds_differ_and_use_the_range(paths):
    speeds = np.concatenate([path.speed for path in paths])
    assert np.percentile(speeds, 10) < 1.8
    assert np.percentile(speeds, 90) > 3.2


def test_turns_are_those_of_people_who_run(paths):
    for path in paths:
        rate = np.abs(np.diff(path.heading)) / STEP
        assert rate.max() <= TURN_RATE + 1e-9  # rounding
        # The rate lags by a quarter second, in which the speed changes by less than a quarter.
        assert (rate * path.speed[:-1]).max() <= 1.25 * LATERAL_ACCELERATION


def test_headings_never_jump(paths):
    for path in paths:
        assert np.abs(np.diff(path.heading, 2)).max() / STEP**2 < 20.0  # [rad/s^2]


def test_people_stay_about_their_area(paths):
    for path in paths:
        away = np.abs(path.position - CROWD.area_center) - 0.5 * np.array(CROWD.area_size)
        # A runner at 4 m/s needs 4 m to come about.
        assert away.max() < 5.0


def test_people_keep_clear_of_each_other(paths):
    place = np.array([path.position for path in paths])
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1)
    apart[np.arange(len(paths)), np.arange(len(paths))] = np.inf
    # A body is 0.5 m wide; now and then six people in 20 x 14 m brush past each other.
    assert (apart < 0.5).mean() < 0.01


def test_those_who_come_later_change_nobody_before(paths):
    again = [wander(CROWD, 20.0, (), np.random.default_rng(0))]
    np.testing.assert_array_equal(again[0].position, paths[0].position)


def test_a_longer_clip_begins_alike():
    long, short = (wander(CROWD, t, (), np.random.default_rng(5)) for t in (8.0, 4.0))
    n = len(short.time)
    np.testing.assert_array_equal(long.position[:n], short.position)
