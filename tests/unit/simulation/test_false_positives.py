import numpy as np
import pytest

from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, ObservationNoise
from worldpose.simulation.false_positives import PHANTOMS, draw_false_positives
from worldpose.simulation.gait import RIGID_BONES

TINY = SCENARIOS["tiny"]


def drawn(noise, frames=20_000, seed=0):
    scenario = TINY.model_copy(update={"noise": noise})
    return draw_false_positives(
        scenario, PitchTemplate.standard(), frames, np.random.default_rng(seed)
    ).joints


def test_as_many_as_the_settings_say_and_as_long():
    joints = drawn(ObservationNoise(false_people=0.4, false_people_time=0.3))
    there = np.isfinite(joints[..., 0, 0])
    # Some 1000 stretches: standard error 3 %, of the count and of the length.
    assert there.sum(axis=1).mean() == pytest.approx(0.4, rel=0.15)
    appearances = (there[1:] & ~there[:-1]).sum()
    assert there.sum() / appearances / TINY.fps == pytest.approx(0.3, rel=0.15)


def test_they_stand_still_and_come_back_elsewhere():
    joints = drawn(ObservationNoise(false_people=0.4), frames=2000)
    step = np.linalg.norm(np.diff(joints[:, :, 0], axis=0), axis=-1)
    assert np.nanmax(step) == 0.0
    places = {tuple(place) for place in joints[:, 0, 0] if np.isfinite(place[0])}
    assert len(places) > 20


def test_they_have_human_bones_and_stand_on_the_pitch():
    joints = drawn(ObservationNoise(false_people=0.4), frames=2000)
    for a, b in RIGID_BONES:
        length = np.linalg.norm(joints[..., a, :] - joints[..., b, :], axis=-1)
        # Rounding at 100 m from the origin of the walk they are taken from.
        assert np.nanmax(length) - np.nanmin(length) < 1e-11
    lowest = np.nanmin(joints[..., 2].min(axis=-1))
    assert -0.2 < lowest < 0.15


def test_no_rate_no_phantoms():
    joints = drawn(ObservationNoise.none(), frames=100)
    assert joints.shape == (100, PHANTOMS, 17, 3)
    assert np.isnan(joints).all()
