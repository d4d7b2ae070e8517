import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.pitch import PitchTemplate
from worldpose.simulation import SCENARIOS, BroadcastSettings
from worldpose.simulation.football import play
from worldpose.simulation.scene import move_broadcast_camera, place_camera

TIMES = np.arange(1500) / 50.0
PATHS, BALL = play(SCENARIOS["match"].crowd, 30.0, np.random.default_rng(2))


def filmed(seed=0, **settings):
    return move_broadcast_camera(
        BroadcastSettings(**settings),
        TIMES,
        BALL.position,
        BALL.time,
        (1920, 1080),
        np.random.default_rng(seed),
    )


@pytest.fixture(scope="module", params=range(4))
def camera(request):
    return filmed(request.param)


def axes(camera):
    return camera.cam_from_world.rotation[:, 2]


def test_the_center_is_on_the_main_stand_and_never_moves(camera):
    center = camera.center
    assert camera.batch_shape == (1500,)
    assert np.ptp(center, axis=0).max() < 1e-9  # rounding at 90 m
    assert abs(center[0, 0]) <= 0.3
    assert -88.0 <= center[0, 1] <= -67.0
    assert 12.0 <= center[0, 2] <= 19.0


def test_the_lens_is_that_of_the_released_clips(camera):
    focal, (k1, k2) = camera.focal[:, 0], camera.distortion[:, :2].T
    assert (camera.focal[:, 1] == focal).all()
    assert 2400.0 < focal.min() < focal.max() < 7100.0
    # 20 clips: k1 0.08 to 0.99, k2 -1.1 to 4.3 and rising with the zoom.
    assert 0.1 < k1.min() < k1.max() <= 1.0
    assert 0.6 < k2.min() < k2.max() <= 4.3
    assert (camera.distortion[:, 2:] == 0.0).all()
    assert np.corrcoef(focal, k1)[0, 1] > 0.9
    assert 940.0 < camera.principal_point[0, 0] < 1010.0
    assert 470.0 < camera.principal_point[0, 1] < 540.0


def test_zooms_are_as_quick_as_operators_zoom(camera):
    step = np.abs(np.diff(camera.focal[:, 0]))
    # The clips' 95th percentile is 4 to 20 px per frame.
    assert 2.0 < np.percentile(step, 95) < 24.0


def test_it_pans_and_tilts_smoothly(camera):
    forward = axes(camera)
    rate = np.degrees(np.linalg.norm(np.diff(forward, axis=0), axis=-1)) * 50.0
    # A pass of 20 m at 75 m in two seconds is 8 degrees/s; sprints and long balls double it.
    assert 1.0 < np.percentile(rate, 90) < 20.0
    change = np.degrees(np.linalg.norm(np.diff(forward, 2, axis=0), axis=-1)) * 50.0**2
    assert change.max() < 150.0  # [degrees/s^2]: a damped head, nothing jerks
    tilt = np.degrees(np.arcsin(-forward[:, 2]))
    assert 4.0 < tilt.min() < tilt.max() < 22.0
    pan = np.degrees(np.arctan2(forward[:, 0], forward[:, 1]))
    assert np.abs(pan).max() < 45.0


def test_it_stands_upright(camera):
    roll = np.degrees(np.arcsin(camera.cam_from_world.rotation[:, 0, 2]))
    assert np.abs(roll).max() < 0.6  # the clips' first frames: -0.2 to 0.4


def test_the_action_is_in_the_picture(camera):
    ball = np.stack([np.interp(TIMES, BALL.time, axis) for axis in BALL.position.T], axis=-1)
    pixels = camera.project(np.column_stack([ball, 0.0 * TIMES])[:, None])[:, 0]
    inside = ((pixels >= 0) & (pixels <= [1919, 1079])).all(-1)
    assert inside.mean() > 0.8


def test_players_are_60_to_170_px_tall(camera):
    feet = np.array([[np.interp(TIMES, p.time, axis) for axis in p.position.T] for p in PATHS[:22]])
    feet = np.concatenate([np.moveaxis(feet, 1, 2), np.zeros((22, 1500, 1))], axis=-1)
    feet = np.moveaxis(feet, 0, 1)
    low, high = camera.project(feet), camera.project(feet + np.array([0.0, 0.0, 1.85]))
    inside = ((low >= 0) & (low <= [1919, 1079]) & (high >= 0)).all(-1)
    tall = np.linalg.norm(high - low, axis=-1)[inside]
    # Boxes of the clips: 58 to 170 px at the tenth and ninetieth percentile, median 76 to 118.
    assert 70.0 < np.median(tall) < 130.0
    assert inside.sum(axis=1).mean() > 5.0


def test_every_lens_is_one_to_one_in_the_whole_picture(camera):
    u, v = np.meshgrid(np.linspace(0, 1919, 5), np.linspace(0, 1079, 5))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    for one in (camera[0], camera[int(np.argmin(camera.focal[:, 0]))]):
        rays = one.unproject(pixels)
        back = one.project(rays.origins + 70.0 * rays.directions)
        np.testing.assert_allclose(back, pixels, atol=1e-6)


def test_a_sweep_pans_and_a_zoom_range_is_used():
    pan = np.arctan2(*axes(filmed(sweep_m=22.0))[:, :2].T)
    assert np.ptp(np.degrees(pan)) > 15.0
    focal = filmed(focal_px=(2500.0, 7000.0), zoom_period_s=(14.0, 20.0)).focal[:, 0]
    # 30 s hold a whole period.
    assert focal.min() == pytest.approx(2500.0, rel=0.01)
    assert focal.max() == pytest.approx(7000.0, rel=0.01)


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
    """Pixels from foot to head of people of 1.8 m; NaN where not wholly in the image."""
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
    # People beyond a camera's own area, across the pitch, are smaller.
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
