import numpy as np
import pytest

from data_contracts.pitch import PitchSpec
from worldpose.geometry.cameras import Camera
from worldpose.pitch.template import PitchTemplate
from worldpose.simulation.annotations import add_calibration_errors, click
from worldpose.simulation.scenarios import SCENARIOS
from worldpose.simulation.scene import look_at, place_camera
from worldpose.simulation.settings import CalibrationErrors, ClickSettings

PITCH = PitchTemplate.standard()
NOBODY = np.empty((0, 17, 3))


@pytest.fixture(scope="module")
def camera():
    """Sees the left half of the pitch from the near stand."""
    return Camera(
        focal=np.array([1500.0, 1500.0]),
        principal_point=np.array([959.5, 539.5]),
        distortion=np.array([-0.05, 0.01, 0.0, 0.0, 0.0]),
        cam_from_world=look_at(np.array([-30.0, -70.0, 22.0]), np.array([-32.0, 0.0, 0.0]), 0.0),
        image_size=np.array([1920, 1080]),
    )


def clicked(camera, seed, people=NOBODY, *, clustered=False, mistaken=False, **settings):
    return click(
        camera,
        PITCH,
        people,
        ClickSettings(**settings),
        clustered=clustered,
        mistaken=mistaken,
        rng=np.random.default_rng(seed),
    )


def offsets(camera, clicks):
    """Pixels from the named points to where they were clicked, (points, 2)."""
    names = [point.name for point in clicks.markings.points]
    found = np.array([point.xy for point in clicks.markings.points]).reshape(-1, 2)
    return found - camera.project(PITCH.positions(names))


def test_clicks_are_as_many_and_as_exact_as_stated(camera):
    errors = []
    for seed in range(20):
        clicks = clicked(camera, seed)
        assert 8 <= len(clicks.markings.points) <= 12
        assert len({point.name for point in clicks.markings.points}) == len(clicks.markings.points)
        assert not clicks.markings.drawn
        assert not clicks.wrong
        errors.append(offsets(camera, clicks).ravel())
    # Some 400 numbers: the spread is known to 3.5 %; the rounding to 0.01 px does not show.
    assert np.std(np.concatenate(errors)) == pytest.approx(1.0, rel=0.1)


def test_a_mistake_is_one_click_named_for_another_or_far_off_and_the_truth_says_which(camera):
    kinds = set()
    for seed in range(30):
        clicks = clicked(camera, seed, mistaken=True, noise_px=0.0)
        far = np.linalg.norm(offsets(camera, clicks), axis=-1)
        # Clicks are written to a hundredth of a pixel.
        assert (far > 0.02).sum() == 1
        (wrong,) = clicks.wrong
        assert clicks.markings.points[int(np.argmax(far))].name == wrong
        assert far.max() > 19.9
        kinds.add(clicks.wrong[wrong] == wrong)
        if clicks.wrong[wrong] != wrong:
            xy = clicks.markings.points[int(np.argmax(far))].xy
            there = camera.project(PITCH.positions([clicks.wrong[wrong]]))[0]
            np.testing.assert_allclose(xy, there, atol=0.0051)
    assert kinds == {True, False}


RIG = SCENARIOS["match"].rig


@pytest.fixture(scope="module")
def cameras():
    rngs = [np.random.default_rng(i) for i in range(18)]
    return {
        f"cam{i:02d}": place_camera(RIG, i, np.zeros(3), PitchSpec(), rng)
        for i, rng in enumerate(rngs)
    }


def misjudged(cameras, seed=0, **errors):
    return add_calibration_errors(cameras, CalibrationErrors(**errors), np.random.default_rng(seed))


def angles(cameras, given):
    turned = [
        given[name].cam_from_world.rotation @ camera.cam_from_world.rotation.T
        for name, camera in cameras.items()
    ]
    return np.arccos(np.clip([(np.trace(turn) - 1.0) / 2.0 for turn in turned], -1.0, 1.0))


def test_bad_cameras_are_as_many_and_as_bad_as_stated(cameras):
    usual = angles(cameras, misjudged(cameras, rotation_rad=0.0001))
    some = angles(cameras, misjudged(cameras, rotation_rad=0.0001, bad_cameras=3, bad_factor=100.0))
    # 18 angles, chi with 3 degrees of freedom: mean 1.6 of the spread per axis, give or take 10 %.
    assert usual.mean() == pytest.approx(0.00016, rel=0.35)
    ratio = some / usual
    assert np.sort(ratio)[-3:] == pytest.approx(100.0, rel=0.01)
    assert np.sort(ratio)[:-3] == pytest.approx(1.0, rel=0.01)
