import numpy as np
import pytest

from worldpose.simulation import SCENARIOS
from worldpose.simulation.crowd import SHOVED, run_through, take_corner
from worldpose.simulation.paths import MARGIN, STEP
from worldpose.simulation.settings import CrowdSettings

CORNER = SCENARIOS["corner-kick"].crowd
CROSSING = SCENARIOS["crossing"].crowd
WITHIN = slice(round(MARGIN / STEP), -round(MARGIN / STEP))


@pytest.fixture(scope="module")
def corner():
    return take_corner(CORNER, 4.0, np.random.default_rng(1))


@pytest.fixture(scope="module")
def crossing():
    return run_through(CROSSING, 4.0, np.random.default_rng(1))


def gaps(paths):
    """Distances of all pairs (samples, pairs) [m] during the clip."""
    place = np.array([path.position for path in paths]).swapaxes(0, 1)[WITHIN]
    first, second = np.triu_indices(len(paths), 1)
    return np.linalg.norm(place[:, first] - place[:, second], axis=-1)


def longest(near):
    """The longest stretch of every pair (pairs,) [s]."""
    run, most = np.zeros(near.shape[1]), np.zeros(near.shape[1])
    for row in near:
        run = np.where(row, run + STEP, 0.0)
        most = np.maximum(most, run)
    return most


@pytest.mark.parametrize("name", ["corner", "crossing"])
def test_pairs_stay_in_touch_for_a_third_of_a_second_and_nobody_walks_through_another(
    name, request
):
    gap = gaps(request.getfixturevalue(name))
    assert (longest(gap < 0.5) >= 0.3).any()
    # A trunk is 0.2 to 0.25 m deep: two cannot come nearer, whichever way they turn.
    assert gap.min() > 0.2


@pytest.mark.parametrize("name", ["corner", "crossing"])
def test_ways_are_smooth_and_speeds_those_of_the_ways(name, request):
    for path in request.getfixturevalue(name):
        velocity = np.diff(path.position, axis=0) / STEP
        np.testing.assert_allclose(np.linalg.norm(velocity, axis=-1), path.speed[:-1], atol=1e-9)
        change = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / STEP
        assert change.max() <= SHOVED + 1e-6
        # At the usual TURN_RATE of 6 rad/s; no jumps by a full turn.
        assert np.abs(np.diff(path.heading)).max() <= 6.0 * STEP + 1e-9


def test_the_ball_draws_people_and_those_near_it_jump(corner):
    jumpers = [path for path in corner if path.actions]
    assert len(jumpers) >= 3
    place = np.array([path.position for path in jumpers])[:, round((MARGIN + 1.8) / STEP)]
    # All of them within 2.2 m of where the ball comes down.
    assert np.linalg.norm(place - place.mean(axis=0), axis=-1).max() < 4.4


def test_markers_stay_with_their_attackers_on_the_goals_side(corner):
    place = np.array([path.position for path in corner])[:, WITHIN]
    apart = place[1:-1:2] - place[0:-2:2][: len(place[1:-1:2])]
    assert np.median(np.linalg.norm(apart, axis=-1)) < 1.0
    assert np.median(apart[..., 0]) > 0.0  # the goal lies at positive x


def test_the_last_person_keeps_the_goal(corner):
    place = corner[-1].position[WITHIN]
    goal = np.array([CORNER.area_center_m[0] + 0.5 * CORNER.area_size_m[0], 0.0])
    assert np.linalg.norm(place - goal, axis=-1).max() < 4.0


def test_runners_cross_the_middle_at_a_run(crossing):
    place = np.array([path.position for path in crossing])[:, WITHIN]
    far = np.linalg.norm(place - CROSSING.area_center_m, axis=-1)
    assert np.median(far.min(axis=1)) < 0.7
    assert far.min(axis=1).max() < 3.0
    assert np.array([path.speed[WITHIN].max() for path in crossing]).min() > 2.5


@pytest.mark.parametrize("go", [take_corner, run_through])
@pytest.mark.parametrize("people", [0, 1, 2, 3])
def test_few_people_and_nobody_have_ways_too(go, people):
    paths = go(CrowdSettings(people=people), 0.4, np.random.default_rng(0))
    assert len(paths) == people
    for path in paths:
        assert np.isfinite(path.position).all()
        assert path.time[0] == -MARGIN
