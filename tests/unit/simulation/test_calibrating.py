import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.simulation import SCENARIOS, CalibrationErrors
from worldpose.simulation.calibrating import PIVOT, misjudge
from worldpose.simulation.stadium import place_camera

RIG = SCENARIOS["match"].rig


@pytest.fixture(scope="module")
def cameras():
    rngs = [np.random.default_rng(i) for i in range(18)]
    return {
        f"cam{i:02d}": place_camera(RIG, i, np.zeros(3), PitchSpec(), rng)
        for i, rng in enumerate(rngs)
    }


def misjudged(cameras, seed=0, **errors):
    return misjudge(cameras, CalibrationErrors(**errors), np.random.default_rng(seed))


def angles(cameras, given):
    turned = [
        given[name].cam_from_world.rotation @ camera.cam_from_world.rotation.T
        for name, camera in cameras.items()
    ]
    return np.arccos(np.clip([(np.trace(turn) - 1.0) / 2.0 for turn in turned], -1.0, 1.0))


def test_no_errors_give_the_true_cameras(cameras):
    for name, camera in misjudged(cameras).items():
        assert camera is cameras[name]


def test_rotations_err_as_stated_about_an_unmoved_center(cameras):
    given = misjudged(cameras, rotation=0.001)
    # 18 angles, chi with 3 degrees of freedom: mean 1.6 of the spread per axis, give or take 10 %.
    assert angles(cameras, given).mean() == pytest.approx(0.0016, rel=0.35)
    for name, camera in given.items():
        np.testing.assert_allclose(camera.center, cameras[name].center, atol=1e-9)
        np.testing.assert_array_equal(camera.focal, cameras[name].focal)


def test_a_wrong_center_keeps_the_middle_of_the_picture(cameras):
    given = misjudged(cameras, center=0.5)
    shifts = [np.linalg.norm(given[n].center - camera.center) for n, camera in cameras.items()]
    assert np.mean(shifts) == pytest.approx(0.8, rel=0.35)  # 1.6 spreads again
    for name, camera in cameras.items():
        pivot = camera.center + PIVOT * camera.cam_from_world.rotation[2]
        before, after = camera.project(pivot[None]), given[name].project(pivot[None])
        np.testing.assert_allclose(after, before, atol=1e-6)
        # Rounding aside it is still a rotation.
        rotation = given[name].cam_from_world.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_focal_lengths_err_relatively(cameras):
    given = misjudged(cameras, focal=0.01)
    off = [given[name].focal[0] / camera.focal[0] - 1.0 for name, camera in cameras.items()]
    assert np.std(off) == pytest.approx(0.01, rel=0.5)  # 18 draws


def test_bad_cameras_are_as_many_and_as_bad_as_stated(cameras):
    usual = angles(cameras, misjudged(cameras, rotation=0.0001))
    some = angles(cameras, misjudged(cameras, rotation=0.0001, bad_cameras=3, bad_factor=100.0))
    ratio = some / usual
    assert np.sort(ratio)[-3:] == pytest.approx(100.0, rel=0.01)
    assert np.sort(ratio)[:-3] == pytest.approx(1.0, rel=0.01)
