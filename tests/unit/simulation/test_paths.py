from dataclasses import replace

import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.simulation import SCENARIOS, CrowdSettings
from worldpose.simulation.football import play
from worldpose.simulation.gait import stride_cycle, walk
from worldpose.simulation.paths import (
    LATERAL_ACCELERATION,
    MARGIN,
    STEP,
    TURN_RATE,
    GroundPath,
    wander,
)
from worldpose.simulation.settings import ActionRates
from worldpose.simulation.skeletons import draw_body

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
        assert path.speed.min() >= CROWD.speed_m_s[0]
        assert path.speed.max() <= CROWD.speed_m_s[1]


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
        away = np.abs(path.position - CROWD.area_center_m) - 0.5 * np.array(CROWD.area_size_m)
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


ANKLES = [COCO17.index("left_ankle"), COCO17.index("right_ankle")]
FPS = 100.0


def along_x(speed):
    """A path along x whose speed is a function of time."""
    time = np.arange(round((8.0 + 2 * MARGIN) / STEP) + 1) * STEP - MARGIN
    speeds = speed(time)
    x = np.concatenate([[0.0], np.cumsum(speeds[:-1]) * STEP])
    return GroundPath(
        time, np.stack([x, 0.0 * x], axis=-1), np.zeros_like(time), speeds.astype(float)
    )


def walked(path, seed=0):
    rng = np.random.default_rng(seed)
    body = draw_body((1.8, 1.8), rng)
    times = np.arange(0.0, 8.0, 1.0 / FPS)
    return body, walk(body, path, times, lambda x, y: 0.0 * x, rng)


STOP = along_x(lambda t: 2.0 * np.clip(3.0 - t, 0.0, 1.0) + 2.0 * np.clip(t - 5.0, 0.0, 1.0))


@pytest.mark.parametrize("seed", range(5))
def test_who_stands_has_both_feet_on_the_ground_and_keeps_them_there(seed):
    body, joints = walked(STOP, seed)
    ankles = joints[320:500, ANKLES]  # from 3.2 to 5 s nothing moves
    assert np.abs(np.diff(ankles, axis=0)).max() < 1e-9
    np.testing.assert_allclose(ankles[..., 2], body.ankle_height, atol=0.01)  # a heel may rise
    hands = joints[320:500, 9:11]
    assert np.abs(np.diff(hands, axis=0)).max() < 1e-9


def test_who_never_moves_stands_from_beginning_to_end():
    _, joints = walked(along_x(lambda t: 0.0 * t))
    assert np.abs(np.diff(joints[:, 5:], axis=0)).max() < 1e-12  # only the head turns
    assert (joints[0, 5:, 2] > 0.05).all()


def test_walking_begins_and_ends_with_whole_steps():
    cycle = stride_cycle(STOP, 0.3)
    standing = cycle[STOP.speed == 0.0]
    assert np.ptp(standing) == 0.0
    assert standing[0] % 0.5 == pytest.approx(0.25, abs=1e-9)
    assert (np.diff(cycle) >= 0.0).all()


def test_steps_between_two_rests_are_whole():
    path = along_x(lambda t: 1.5 * np.clip(np.minimum(t - 1.0, 5.0 - t), 0.0, 1.0))
    cycle = stride_cycle(path, 0.0)
    # 4.5 m at up to 1.5 m/s: some 3 strides, rounded to half ones.
    assert 2.0 * (cycle[-1] - cycle[0]) == pytest.approx(round(2.0 * (cycle[-1] - cycle[0])))
    assert 2.0 <= cycle[-1] - cycle[0] <= 4.0


def test_a_pace_aside_takes_a_step_or_two():
    path = along_x(lambda t: 0.8 * np.exp(-0.5 * ((t - 4.0) / 0.25) ** 2))
    cycle = stride_cycle(path, 0.0)
    assert cycle[-1] - cycle[0] in (0.5, 1.0)


def test_who_turns_on_the_spot_takes_steps():
    still = along_x(lambda t: 0.0 * t)
    turned = np.clip(still.time - 2.0, 0.0, 1.0) * np.pi
    path = GroundPath(still.time, still.position, turned, still.speed)
    cycle = stride_cycle(path, 0.0)
    # Half a turn within a second: two steps or three.
    assert 2.0 * (cycle[-1] - cycle[0]) in (1.0, 2.0, 3.0)
    _, joints = walked(path)
    for joint, side in zip(ANKLES, (1.0, -1.0), strict=True):
        before, after = joints[0, joint], joints[-1, joint]
        assert before[1] * side > 0.05
        assert after[1] * side < -0.05


def test_strolling_is_no_marching_on_the_spot():
    for speed in (0.3, 0.6, 0.9):
        cycle = stride_cycle(along_x(lambda t, v=speed: v + 0.0 * t), 0.0)
        stride = speed * 8.0 / (np.interp(8.0, along_x(np.cos).time, cycle) - cycle[200])
        assert 0.55 < stride < 1.15  # a stroller's stride is half a metre and more


def test_feet_of_footballers_stay_on_the_ground_and_near_their_body():
    crowd = SCENARIOS["match"].crowd.model_copy(update={"actions": ActionRates.none()})
    paths, _ = play(crowd, 8.0, np.random.default_rng(4))
    for seed, path in enumerate(paths):
        body, joints = walked(replace(path, actions=()), seed)
        ankles = joints[:, ANKLES]
        assert ankles[..., 2].min() > body.ankle_height - 1e-9
        hips = joints[:, 11:13]
        assert np.linalg.norm(ankles - hips, axis=-1).max() <= body.leg
        # At 9 m/s a foot swings forward at 20 m/s; nothing goes faster, nothing jumps.
        assert np.abs(np.diff(joints, axis=0)).max() * FPS < 25.0
