import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS
from worldpose.simulation.stadium import place_camera

RIG = SCENARIOS["match"].rig
PITCH = PitchTemplate.standard()
UP = np.array([0.0, 0.0, 1.8])


def stadium(seed, count=16):
    rngs = [np.random.default_rng([seed, i]) for i in range(count)]
    target = np.zeros(3)
    return [place_camera(RIG, i, target, PitchSpec(), rng) for i, rng in enumerate(rngs)]


def grid(spacing):
    x, y = np.meshgrid(np.arange(-52.5, 52.6, spacing), np.linspace(-34.0, 34.0, 35))
    return np.stack([x, y, PITCH.height(x, y)], axis=-1).reshape(-1, 3)


def person_heights(camera, feet):
    """Pixels from foot to head of people of 1.8 m; NaN where not wholly in the picture."""
    low, high = camera.project(feet), camera.project(feet + UP)
    inside = ((low >= 0) & (low <= [1919, 1079]) & (high >= 0) & (high <= [1919, 1079])).all(-1)
    return np.where(inside, np.linalg.norm(high - low, axis=-1), np.nan)


@pytest.mark.parametrize("seed", range(4))
def test_every_point_of_the_pitch_is_well_seen_by_four_cameras(seed):
    tall = np.array([person_heights(camera, grid(2.5)) for camera in stadium(seed)])
    seen = ((tall >= 40.0) & (tall <= 150.0)).sum(axis=0)
    counts = np.bincount(seen)
    print(f"cameras that see a point with people 40 to 150 px tall: {counts / counts.sum()}")
    assert seen.min() >= 4
    assert np.median(seen) >= 6


def test_people_are_40_to_150_px_tall_nearly_wherever_a_camera_looks():
    tall = np.array([person_heights(camera, grid(2.5)) for camera in stadium(0)])
    tall = tall[np.isfinite(tall)]
    # What lies beyond a camera's own part, across the whole pitch, is smaller.
    assert ((tall >= 40.0) & (tall <= 150.0)).mean() > 0.85
    assert tall.min() > 25.0
    assert tall.max() < 160.0


def test_cameras_are_in_the_stands():
    for camera in stadium(1, 18):
        x, y, z = np.abs(camera.center)
        assert max(x - 52.5, y - 34.0) > 10.0
        assert 10.0 <= z <= 30.0


def test_cameras_stand_all_around():
    azimuths = np.sort([np.arctan2(*camera.center[1::-1]) for camera in stadium(0)])
    assert np.diff([*azimuths, azimuths[0] + 2 * np.pi]).max() < np.radians(45.0)


def test_cameras_beyond_the_seats_stand_in_the_ring():
    camera = stadium(0, 19)[18]
    assert max(abs(camera.center[0]) - 52.5, abs(camera.center[1]) - 34.0) > 3.0
