"""The distance of a person from one camera, by feet that stand or are in the air."""

import numpy as np

from worldpose.body_fitting.standing import find_standing_distance

FPS, SLOPE = 50.0, 0.2


def find(distance):
    return find_standing_distance(distance, np.full(len(distance), SLOPE), FPS, 0.01)


def test_feet_in_the_air_do_not_make_a_runner_too_distant():
    rng = np.random.default_rng(0)
    time = np.arange(300) / FPS
    true = 70.0 + 3.0 * time
    # Stands for 0.15 s, then flies for 0.15 s with a lift up to 8 cm.
    phase = np.mod(time, 0.3) / 0.3
    lift = 0.08 * np.where(phase > 0.5, np.sin(2.0 * np.pi * (phase - 0.5)), 0.0)
    found, variance = find(true + lift / SLOPE + rng.normal(0.0, 0.05, 300))
    assert abs(np.mean(found - true)) < 0.5 * np.mean(lift) / SLOPE
    assert np.mean(np.abs(found - true) < 2.0 * np.sqrt(variance)) > 0.8


def test_a_standing_person_has_the_mean_distance_and_gaps_are_bridged():
    rng = np.random.default_rng(1)
    seen = 60.0 + rng.normal(0.0, 0.05, 200)
    seen[80:120] = np.nan
    found, variance = find(seen)
    assert np.abs(found - 60.0).max() < 0.15
    assert variance[100] > 2.0 * variance[40]


def test_short_tracks_have_a_distance():
    for frames in (1, 2, 3):
        found, variance = find(np.full(frames, 50.0))
        np.testing.assert_allclose(found, 50.0, atol=0.01)
        assert (variance > 0.0).all()
