import math

import numpy as np
import pytest

from worldpose.tracking.epipolar import limb_lengths
from worldpose.tracking.joins import End, choose_joins, fit_track_ends, join_costs
from worldpose.tracking.settings import TrackingSettings

SETTINGS = TrackingSettings()
UNKNOWN = np.full(11, np.nan)
FPS = 50.0
AREA = 7140.0


def end(number, frame, place, velocity=(0.0, 0.0), limbs=UNKNOWN):
    variance = np.where(np.isfinite(limbs), 1e-6, np.nan)
    return End(number, frame, np.array(place), np.array(velocity), limbs, variance)


def cost(old, new, settings=SETTINGS):
    return join_costs([old], [new], FPS, AREA, settings).item()


def test_ends_are_where_the_torso_is_and_as_fast_as_it_moves(people):
    frames = np.arange(10, 40)
    time = (frames - 10) / FPS
    joints = people(np.stack([2.0 * time, 1.0 - time], axis=-1))
    start, stop = fit_track_ends(3, frames, joints, FPS, SETTINGS)
    torso = people(np.zeros(2))[[5, 6, 11, 12], :2].mean(axis=0)
    # A line through exact points: rounding.
    np.testing.assert_allclose(start.place, torso + [0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(stop.place, torso + [2.0 * 0.58, 1.0 - 0.58], atol=1e-12)
    np.testing.assert_allclose([start.velocity, stop.velocity], [[2.0, -1.0]] * 2, atol=1e-10)
    assert (start.number, start.frame, stop.frame) == (3, 10, 39)
    np.testing.assert_allclose(start.limbs[0], 0.36, atol=1e-12)


def test_who_goes_on_as_expected_costs_less_than_who_turned_and_than_who_is_elsewhere():
    runner = end(0, 0, (0.0, 0.0), (5.0, 0.0))
    # Half the way that both velocities would take, with the memory of one second.
    ahead = 5.0 * (1.0 - math.exp(-0.5))
    on = cost(runner, end(1, 25, (ahead, 0.0), (5.0, 0.0)))
    turned = cost(runner, end(1, 25, (ahead, 0.0), (-5.0, 0.0)))
    elsewhere = cost(runner, end(1, 25, (0.0, ahead), (5.0, 0.0)))
    assert on < 0.0
    assert turned > on + 3.0
    assert elsewhere > on + 3.0


def decided(costs, odds=1.0):
    before = [end(n, 0, (0, 0)) for n in range(len(costs))]
    after = [end(10 + n, 50, (0, 0)) for n in range(len(costs[0]))]
    chosen = SETTINGS.model_copy(update={"newcomer_odds": odds})
    return [
        (join.before, join.after, join.decided, join.margin)
        for join in choose_joins(before, after, np.array(costs), chosen)
    ]


def test_likeliest_way_is_taken_and_told_by_its_margin():
    # 0-10 and 1-11 cost -14 together, 0-11 and 1-10 cost -4, one join alone -8 at best.
    assert decided([[-8.0, -2.0], [-2.0, -6.0]]) == [(0, 10, True, 8.0), (1, 11, True, 6.0)]


def test_odds_beforehand_tell_newcomers_from_who_was_lost():
    assert decided([[4.0]], odds=0.05) == []
    (join,) = decided([[4.0]], odds=0.001)
    assert join[:3] == (0, 10, True)
    # Odds of 1000 to 1 beforehand, of e^-4 after looking.
    assert join[3] == pytest.approx(math.log(1000.0) - 4.0)


def test_a_limb_is_the_surer_the_longer_it_was_seen_and_the_steadier_it_was(people):
    def seen(lengths):
        joints = people(np.zeros((len(lengths), 2)))
        joints[:, 7] = joints[:, 5] + np.array(lengths)[:, None] * [0.0, 0.0, -1.0]
        median, variance = limb_lengths(joints, FPS)
        return median[1], variance[1]

    # 5 cm at least, for a single frame and for what is forgotten in 0.3 s, 15 frames.
    assert seen([0.3]) == pytest.approx((0.3, 0.0025))
    assert seen([0.3] * 60) == pytest.approx((0.3, 0.0025 / 4.0))
    # 10 cm to either side of the median in half of the frames and more.
    assert seen([0.2, 0.3, 0.4] * 20) == pytest.approx((0.3, (1.4826 * 0.1) ** 2 / 4.0))


def test_grossly_wrong_limb_is_no_proof_of_another_person():
    # Two views took a neighbour's elbow: the upper arm of one track is a metre longer.
    length = np.full(11, 0.4)
    wrong = length.copy()
    wrong[2] += 1.0
    same = cost(end(0, 0, (0.0, 0.0), limbs=length), end(1, 25, (0.0, 0.0), limbs=length))
    off = cost(end(0, 0, (0.0, 0.0), limbs=length), end(1, 25, (0.0, 0.0), limbs=wrong))
    assert 0.0 < off - same < 1.5
    # All limbs 5 cm longer: twice what people differ by, and said by every limb.
    other = cost(end(0, 0, (0.0, 0.0), limbs=length), end(1, 25, (0.0, 0.0), limbs=length + 0.05))
    assert other - same > 1.5
