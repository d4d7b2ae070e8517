from dataclasses import replace

import numpy as np
import pytest

from data_contracts.conventions import COCO17
from worldpose.simulation import SCENARIOS
from worldpose.simulation.bodies import draw_body
from worldpose.simulation.football import play
from worldpose.simulation.gait import stride_cycle, walk
from worldpose.simulation.paths import MARGIN, STEP, GroundPath
from worldpose.simulation.settings import ActionRates

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
