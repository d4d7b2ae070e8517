"""Who comes back is the same person by shape, not by being the only one; the odds are exported."""

import numpy as np
import pytest

from data_contracts.tracking import Join
from worldpose.tracking.joins import End, Takeover, choose_joins, identity_certainty, join_costs
from worldpose.tracking.settings import TrackingSettings

SETTINGS = TrackingSettings()
LIMBS = np.full(11, 0.36)


def end(number, frame, limbs=LIMBS, place=(0.0, 0.0)):
    return End(number, frame, np.array(place), np.zeros(2), limbs, np.full(11, 4e-5))


def decided(before, after):
    costs = join_costs(before, after, 25.0, 300.0, SETTINGS)
    return [
        (join.before, join.after)
        for join in choose_joins(before, after, costs, 25.0, SETTINGS)
        if join.decided
    ]


def test_a_person_is_back_after_ten_seconds_only_with_the_own_size():
    gone, other = end(0, 100), end(1, 110, LIMBS + 0.03)
    same, unlike = end(2, 350, place=(4.0, 3.0)), end(3, 360, LIMBS - 0.02)
    assert decided([gone, other], [same]) == [(0, 2)]
    # One has left, and one comes: that alone is no evidence.
    assert decided([gone], [unlike]) == []
    assert decided([gone], [end(4, 350, np.full(11, np.nan))]) == []
    # After minutes, a place tells nothing.
    patient = TrackingSettings(max_join_gap_s=200.0)
    (cost,) = join_costs([gone], [end(6, 5000)], 25.0, 300.0, patient).ravel()
    assert np.isfinite(cost)
    # A moment unseen needs no shape.
    assert decided([gone], [end(5, 110, np.full(11, np.nan))]) == [(0, 5)]


def test_certainty_falls_at_every_return_and_not_at_a_confirmed_one():
    def join(first_frame, margin, after=7, is_decided=True):
        last = first_frame - 5
        return Join(before=7, after=after, last_frame=last, first_frame=first_frame, cost=0.0,
                    margin=margin, decided=is_decided)  # fmt: skip

    joins = [join(10, np.log(9.0)), join(20, None), join(30, np.log(4.0)), join(5, 1.0, 8, False)]
    found = identity_certainty(joins, np.array([7, 8]), 40)
    assert found[[0, 9, 10, 29, 30, 39], 0] == pytest.approx([1, 1, 0.9, 0.9, 0.72, 0.72])
    assert (found[:, 1] == 1.0).all()


def test_a_track_that_may_show_another_person_is_as_likely_either():
    join = Takeover(frame=20, person=7, other=-1).join
    found = identity_certainty([join], np.array([7, 8]), 40)
    assert found[[0, 19, 20, 39], 0] == pytest.approx([1, 1, 0.5, 0.5])
    assert (found[:, 1] == 1.0).all()
