import numpy as np

from data_contracts.pitch import PitchSpec
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.movements import play
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import move_broadcast_camera, place_camera
from worldpose.simulation.settings import BroadcastSettings

TIMES = np.arange(1500) / 50.0
PATHS, BALL = play(SCENARIOS["match"].crowd, 30.0, np.random.default_rng(2))


def test_players_are_60_to_170_px_tall():
    camera = move_broadcast_camera(
        *(BroadcastSettings(), TIMES, BALL, PATHS[0].time, (1920, 1080)), np.random.default_rng(0)
    )
    feet = np.array([[np.interp(TIMES, p.time, axis) for axis in p.position.T] for p in PATHS[:22]])
    feet = np.concatenate([np.moveaxis(feet, 1, 2), np.zeros((22, 1500, 1))], axis=-1)
    feet = np.moveaxis(feet, 0, 1)
    low, high = camera.project(feet), camera.project(feet + np.array([0.0, 0.0, 1.85]))
    inside = ((low >= 0) & (low <= [1919, 1079]) & (high >= 0)).all(-1)
    tall = np.linalg.norm(high - low, axis=-1)[inside]
    # Boxes of the clips: 58 to 170 px at the tenth and ninetieth percentile, median 76 to 118.
    assert 70.0 < np.median(tall) < 130.0
    assert inside.sum(axis=1).mean() > 5.0


RIG = SCENARIOS["match"].rig
PITCH = PitchTemplate.standard()
UP = np.array([0.0, 0.0, 1.8])


def person_heights(camera, feet):
    """Pixels from foot to head of people of 1.8 m; NaN where not wholly in the image."""
    low, high = camera.project(feet), camera.project(feet + UP)
    inside = ((low >= 0) & (low <= [1919, 1079]) & (high >= 0) & (high <= [1919, 1079])).all(-1)
    return np.where(inside, np.linalg.norm(high - low, axis=-1), np.nan)


def test_every_point_of_the_pitch_is_well_seen_by_four_cameras():
    rngs = [np.random.default_rng([2, i]) for i in range(16)]
    rig = [place_camera(RIG, i, np.zeros(3), PitchSpec(), rng) for i, rng in enumerate(rngs)]
    x, y = np.meshgrid(np.arange(-52.5, 52.6, 2.5), np.linspace(-34.0, 34.0, 35))
    grid = np.stack([x, y, PITCH.height(x, y)], axis=-1).reshape(-1, 3)
    tall = np.array([person_heights(camera, grid) for camera in rig])
    seen = ((tall >= 40.0) & (tall <= 150.0)).sum(axis=0)
    assert seen.min() >= 4
    assert np.median(seen) >= 6
