import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.simulation import RigSettings
from worldpose.simulation.stadium import place_camera

RIG = RigSettings()
UP = np.array([0.0, 0.0, 1.0])
TARGET = np.array([-20.0, 14.0, -0.03])


def ring(count):
    return [
        place_camera(RIG, i, TARGET, PitchSpec(), np.random.default_rng(i)) for i in range(count)
    ]


def test_cameras_stand_off_the_pitch_where_the_settings_say():
    for camera in ring(12):
        x, y, z = camera.center
        beyond = max(abs(x) - 52.5, abs(y) - 34.0)
        # Along a slanted way of 6 m and more behind the line, at most 1.5 m more or a third less.
        assert beyond > 3.0
        assert beyond < 30.0
        assert 10.0 <= z - TARGET[2] <= 20.0
        assert camera.image_size.tolist() == [1920, 1080]
        assert camera.distortion[2:].tolist() == [0.0, 0.0, 0.0]


def test_cameras_surround_the_target():
    azimuths = sorted(np.arctan2(*(camera.center - TARGET)[1::-1]) for camera in ring(6))
    gaps = np.diff([*azimuths, azimuths[0] + 2 * np.pi])
    # Golden steps leave gaps of at most 0.236 turns among six, and cameras stand 0.02 off.
    assert gaps.max() <= 2 * np.pi * (0.237 + 0.04)


def test_the_target_is_near_the_middle_of_the_picture_and_upright():
    for camera in ring(12):
        foot, head = camera.project(TARGET + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.8]]))
        # 1.5 m off the target is 96 px, or 136 px along the diagonal; nearer ones see more.
        assert np.abs(0.5 * (foot + head) - [960, 540]).max() < 150
        assert head[1] < foot[1]
        assert abs(head[0] - foot[0]) < 0.05 * (foot[1] - head[1])


def test_a_standard_person_at_the_target_is_as_tall_as_asked():
    for camera in ring(12):
        foot, head = camera.project(TARGET + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.8]]))
        # The aim is up to 2 m nearer or farther than the target, of at least 30 m: 7 %.
        assert foot[1] - head[1] == pytest.approx(115.0, rel=0.07)


def test_people_in_the_area_are_80_to_200_px_tall():
    corners = TARGET + np.array([[x, y, 0.0] for x in (-10, 10) for y in (-7, 7)])
    for camera in ring(12):
        for height, least, most in ((1.7, 75.0, 190.0), (1.95, 80.0, 215.0)):
            feet, heads = camera.project(corners), camera.project(corners + height * UP)
            tall = np.linalg.norm(heads - feet, axis=-1)
            assert least < tall.min()
            assert tall.max() < most


def test_lenses_are_one_to_one_in_the_whole_picture():
    u, v = np.meshgrid(np.linspace(0, 1919, 9), np.linspace(0, 1079, 9))
    for camera in ring(12):
        pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
        rays = camera.unproject(pixels)
        # Unprojection converges to 1e-9 px or better (worldpose.geometry).
        np.testing.assert_allclose(
            camera.project(rays.origins + 40.0 * rays.directions), pixels, atol=1e-6
        )
