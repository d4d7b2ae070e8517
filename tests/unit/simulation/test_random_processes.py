import numpy as np
import pytest
from pydantic import ValidationError

from worldpose.simulation import ObservationNoise
from worldpose.simulation.paths import bursts, drift


def lengths_of_stretches(on):
    edges = np.diff(np.concatenate([[0], on.astype(int), [0]]))
    return np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)


def test_drift_has_unit_variance_from_the_first_frame_and_forgets_by_e():
    process = drift((40, 20_000), 0.3, 25.0, np.random.default_rng(0))
    # 20000 independent series: standard error of a variance 0.01, of a correlation 0.007.
    np.testing.assert_allclose(process.var(axis=1), 1.0, atol=0.05)
    lag = round(0.3 * 25.0)
    correlation = (process[0] * process[lag]).mean()
    assert correlation == pytest.approx(np.exp(-lag / (0.3 * 25.0)), abs=0.03)


@pytest.mark.parametrize(("share", "time"), [(0.02, 0.2), (0.3, 0.4), (0.9, 2.0)])
def test_bursts_are_on_for_their_share_and_last_their_time(share, time):
    on = bursts(share, time, (400_000,), 25.0, np.random.default_rng(1))
    stretches = lengths_of_stretches(on)
    # Over 1500 stretches each: standard errors of 3 % of the length, and less of the share's odds.
    assert on.mean() == pytest.approx(share, rel=0.1)
    assert stretches.mean() / 25.0 == pytest.approx(time, rel=0.1)


def test_bursts_shorter_than_a_frame_are_independent_frames():
    on = bursts(0.5, 1e-6, (100_000,), 25.0, np.random.default_rng(2))
    # 100000 coin flips: standard error 0.0016; runs of a fair coin have mean length 2.
    assert on.mean() == pytest.approx(0.5, abs=0.01)
    assert lengths_of_stretches(on).mean() == pytest.approx(2.0, abs=0.05)


def test_bursts_begin_at_their_share_too():
    on = bursts(0.2, 1.0, (3, 50_000), 25.0, np.random.default_rng(3))
    # 50000 draws: standard error 0.0018.
    np.testing.assert_allclose(on.mean(axis=1), 0.2, atol=0.01)


def test_no_share_is_never_on():
    assert not bursts(0.0, 0.2, (1000, 3), 25.0, np.random.default_rng(0)).any()


def test_no_frames_are_no_frames():
    rng = np.random.default_rng(0)
    assert bursts(0.5, 0.2, (0, 2), 25.0, rng).shape == (0, 2)
    assert drift((0, 2), 0.2, 25.0, rng).shape == (0, 2)


def test_none_switches_every_rate_off():
    rates = ObservationNoise.none().model_dump()
    assert {name for name, value in rates.items() if value != 0} == {
        "slow_time_s",
        "person_missed_time_s",
        "stolen_time_s",
        "dropped_time_s",
        "swapped_time_s",
        "false_people_time_s",
    }


@pytest.mark.parametrize("setting", ["white", "swapped", "slow_time_s", "false_people"])
def test_negative_settings_are_refused(setting):
    with pytest.raises(ValidationError):
        ObservationNoise(**{setting: -0.1})
